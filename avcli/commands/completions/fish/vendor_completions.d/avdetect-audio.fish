_AVDETECT_AUDIO_COMPLETE=fish_source avdetect-audio | source
