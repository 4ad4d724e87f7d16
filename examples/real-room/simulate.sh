#!/usr/bin/env bash
# Records, in a simulated room, what real-room.sh needs from a real one: pictures of a board, films, sound.
#   simulate.sh FOLDER
set -euo pipefail
here=$(dirname "$(readlink -f "$0")")
out=${1:?usage: simulate.sh FOLDER}
camera=(--pictures rgb --full-well 8000 --read-noise 1.5 --blur 0.6 -q)  # noise and blur of a plain sensor

python3 "$here/installation.py" scenes "$out/scenes"
mkdir -p "$out/boards"
for scene in "$out"/scenes/boards/view_*.json; do
    name=$(basename "$scene" .json)
    avsim-scene "$scene" -C "$out/tmp" "${camera[@]}" --force -o /dev/null
    mv "$out/tmp/video/rgb/RGB_frame_0.0000000000.png" "$out/boards/$name.png"
done
for name in floor empty walk meeting; do
    avsim-scene "$out/scenes/$name.json" -C "$out/$name" "${camera[@]}" --seed 1 -o "$out/$name.jsonl"
    python3 "$here/installation.py" film "$out/$name" "$out/$name.avi"
done
for name in walk meeting; do
    avsim-audio -C "$out/$name" --noise sensor=40 --seed 1 -q -o /dev/null "$out/$name.jsonl"
    mv "$out/$name/audio/wav/multichannel_audio_0.0000000000.wav" "$out/$name.wav"
done
mv "$out/meeting/groundtruth_sources.jsonl" "$out/truth.jsonl"
mv "$out/floor/video/rgb/RGB_frame_0.0000000000.png" "$out/floor.png"
cp "$out/scenes/room.json" "$out/scenes/truth.json" "$out/"
rm -r "${out:?}"/{tmp,floor,empty,walk,meeting,scenes} "$out"/{floor,empty,walk,meeting}.jsonl "$out/floor.avi"
