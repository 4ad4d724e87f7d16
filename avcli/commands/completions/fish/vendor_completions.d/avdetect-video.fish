_AVDETECT_VIDEO_COMPLETE=fish_source avdetect-video | source
