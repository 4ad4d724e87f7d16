_AVSIM_AUDIO_COMPLETE=fish_source avsim-audio | source
