_AVFUSE_COMPLETE=fish_source avfuse | source
