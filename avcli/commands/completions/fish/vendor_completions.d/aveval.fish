_AVEVAL_COMPLETE=fish_source aveval | source
