#!/bin/sh
# Record the dry voices that avsim-audio ships: one sentence, spoken by espeak-ng in several voices.
# Needs espeak-ng and sox. Run from the top of the repository; the recordings are made once and committed.
set -eu
sentence="Can you keep a secret?"
target=avcli/acoustics/voices
temporary=$(mktemp -d)
trap 'rm -rf "$temporary"' EXIT

record() { # name, espeak-ng voice, words a minute, pitch (0..99)
    espeak-ng -v "$2" -s "$3" -p "$4" -w "$temporary/$1.wav" "$sentence"
    # Cut the silence around the sentence, fade 5 ms, leave 1 dB of headroom.
    sox "$temporary/$1.wav" -b 16 -R "$target/$1.flac" \
        silence 1 0.005 0.3% reverse silence 1 0.005 0.3% fade t 0.005 reverse fade t 0.005 norm -1
}

record 0_ann en-us+f3 165 55
record 1_bob en-gb-x-rp+m3 160 40
record 2_eve en-gb-scotland+f2 170 60
record 3_max en-us+m7 155 35
