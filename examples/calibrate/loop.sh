#!/usr/bin/env bash
# The loop closed: avsim-scene films a board through a known lens, avcalib finds the lens, avdetect-video uses it.
#   loop.sh [FOLDER [VIEWS]]
set -euo pipefail
here=$(dirname "$(readlink -f "$0")")
out=${1:-out/loop}
views=${2:-20}

python3 "$here/board_scenes.py" "$out/scenes" "$views"
mkdir -p "$out/pictures"
for scene in "$out"/scenes/view_*.json; do
    name=$(basename "$scene" .json)
    avsim-scene "$scene" -C "$out/$name" -q -o /dev/null
    mv "$out/$name/video/rgb/RGB_frame_0.0000000000.png" "$out/pictures/$name.png"
    rm -r "${out:?}/$name"
done

avcalib calibrate "$out/pictures" --board 7x10 --square 95 --html "$out/report.html" -o "$out/camera.json"

# A person walks under a camera with the true lens; the detector uses the found one.
avsim-scene s1 -C "$out/s1" -o "$out/scene.jsonl"
jq --slurpfile found "$out/camera.json" '.camera_config += $found[0]' "$out/s1/config.json" >"$out/found.json"
avdetect-video -C "$out/s1" -c "$out/found.json" "$out/scene.jsonl" |
    avfuse -C "$out/s1" -c "$out/found.json" |
    aveval "$out/s1/groundtruth_sources.jsonl" - --format table
