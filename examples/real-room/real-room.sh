#!/usr/bin/env bash
# From a camera and microphones in their boxes to tracks on a page. Each step is a command whose exit status tells
# whether it worked; the script stops at the first one that did not.
#   real-room.sh RECORDED LAB
# RECORDED holds what was recorded (simulate.sh makes it where there is no hardware):
#   boards        pictures or a film of the printed board in front of the camera
#   floor.png     a picture of the board on the floor, taken by the mounted camera
#   empty.avi     a film of the empty room
#   walk.avi walk.wav        one person who walks about and talks, from one moment on
#   meeting.avi meeting.wav  what you want to know
#   room.json     room_config and microphone_config as measured with a tape
# BOARD, SQUARE (mm): the board. AT, YAW: the middle of the board on the floor (m; the board's thickness counts), and the
# direction of its rows (degrees).
set -euo pipefail
here=$(dirname "$(readlink -f "$0")")
in=${1:?usage: real-room.sh RECORDED LAB}
lab=${2:?usage: real-room.sh RECORDED LAB}
board=(--board "${BOARD:-7x10}" --square "${SQUARE:-95}")
read -r -a at <<<"${AT:-2.6 2.5 0.02}"
mkdir -p "$lab"
step() { printf '\n== %s\n' "$*" >&2; }
add() { # adds the keys of a JSON file to lab/config.json
    python3 - "$lab/config.json" "$1" <<'END'
import json, sys
config, more = (json.load(open(path)) for path in sys.argv[1:])
for section, values in more.items():
    config[section] = config.get(section, {}) | values
json.dump(config, open(sys.argv[1], "w"), indent=2)
END
}

step "1. A board to print (measure its rulers afterwards)"
avcalib target "${board[@]}" --paper A0 -o "$lab/board.pdf"

step "2. The lens"
avcalib calibrate "$in/boards" "${board[@]}" -C "$lab" --html "$lab/lens.html" >/dev/null

step "3. What was measured with a tape: the room and the microphones"
add "$in/room.json"

step "4. Where the camera hangs"
avcalib pose "$in/floor.png" "${board[@]}" --at "${at[@]}" --yaw "${YAW:-30}" -C "$lab" >/dev/null

step "5. The empty room"
avcalib background "$in/empty.avi" -C "$lab" -o "$lab/background.json"
add "$lab/background.json"

step "6. The microphones, by a person who walks and talks"
avdetect-video -C "$lab" "$in/walk.avi" | avfuse -C "$lab" --lag inf -o "$lab/walk.jsonl"
avcalib microphones -C "$lab" "$lab/walk.jsonl" --audio "$in/walk.wav" --write >/dev/null

step "7. Is everything there, and plausible?"
avcalib check "$lab" >/dev/null

step "8. Run"
avdetect-video -C "$lab" "$in/meeting.avi" --learn-background -o "$lab/video.jsonl"
avdetect-audio -C "$lab" "$in/meeting.wav" -o "$lab/audio.jsonl"
avfuse -C "$lab" "$lab/audio.jsonl" "$lab/video.jsonl" -o "$lab/tracks.jsonl"

step "9. Look: open $lab/meeting.html"
avview -C "$lab" "$lab"/{audio,video,tracks}.jsonl --film "$in/meeting.avi" --sound "$in/meeting.wav" --html "$lab/meeting.html"

if [ -e "$in/truth.jsonl" ]; then
    step "10. Only where the truth is known: how well did it go?"
    aveval "$in/truth.jsonl" "$lab/tracks.jsonl" --format table
    python3 "$here/compare.py" "$lab/config.json" "$in/truth.json"
fi
