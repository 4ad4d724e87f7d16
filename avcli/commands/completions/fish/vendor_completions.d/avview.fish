_AVVIEW_COMPLETE=fish_source avview | source
