"""`python -m avcli` lists the commands; `python -m avcli avfuse …` runs one."""

import importlib
import sys

COMMANDS = {
    "avsim-scene": "render a scenario through a fisheye lens: colour, depth, ground truth",
    "avsim-audio": "simulate the microphones' signals",
    "avdetect-audio": "localize talkers from the microphones' signals",
    "avdetect-video": "detect people in a ceiling camera's pictures and place them in the room",
    "avfuse": "track people from the detections of several sensors",
    "aveval": "score tracks against ground truth",
    "avcalib": "calibrate a camera, and find the places of microphones",
    "avview": "look at a run: picture, map, sound and lanes on one clock",
}


def main() -> None:
    """Run the command that the first argument names, or list the commands."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name in COMMANDS:
        sys.argv[:2] = [name]
        importlib.import_module(f"avcli.commands.{name.replace('-', '_')}").main()
        return
    lines = [f"  {command:15} {text}" for command, text in COMMANDS.items()]
    listing = "\n".join(
        ["usage: python -m avcli COMMAND [OPTION]…", *lines, "See man ./man/avcli.7 and COMMAND --help."]
    )
    if name in ("", "-h", "--help"):
        print(listing)
        return
    print(f"avcli: {name!r} is not a command\n{listing}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
