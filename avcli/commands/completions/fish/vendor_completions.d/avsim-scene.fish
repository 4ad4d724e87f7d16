_AVSIM_SCENE_COMPLETE=fish_source avsim-scene | source
