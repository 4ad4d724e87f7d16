_AVCALIB_COMPLETE=fish_source avcalib | source
