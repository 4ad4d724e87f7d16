"""The smallest filter: it copies records of detections. The frame's own tests run it as a real process."""

import sys
import time

import click

from avcli.commands.filter import Filter, common


@click.command("copy-records", cls=Filter)
@click.argument("files", nargs=-1, metavar="[FILE]...")
@click.option("--pause", type=float, default=0.0)
@click.option("--number", type=int, default=1, show_default=True)
@common(seed=True, skip_invalid=True, mark_end=True, presets={"thesis": {"number": 42}})
def main(session, files, pause, number):
    """Copy records."""
    from avcli.formats import records

    def parse(record, bad):
        return record, records.detections(record, bad)

    with session.output() as write:
        for record, found in session.records(files, parse):
            time.sleep(pause)
            write({"timestamp": record["timestamp"], "count": len(found), "number": number, "seed": session.seed})


if __name__ == "__main__":
    sys.exit(main())
