"""Room acoustics: image sources, moving sources and microphones, and the sound of people who walk and talk in a room.

`hear` gives the sound of a whole scene; `recorder.Recorder` gives it step by step. `surroundings` makes the room that
is simulated from config.json and `settings`; `absorption` says what its walls absorb, `decay` how its sound dies away,
`images` what paths sound takes. `responses` follows the images while a source moves, `moving` and `sampling` join the
responses along its path, `speakers` and `signals` are the people and their voices, `noise` is added, and `exchange`
writes impulse responses.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avcli.acoustics.recorder import hear as hear


def __getattr__(name: str) -> Any:
    """Import `hear` when it is first asked for: the settings, which --help reads, must not import numpy."""
    if name != "hear":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from avcli.acoustics.recorder import hear

    return hear
