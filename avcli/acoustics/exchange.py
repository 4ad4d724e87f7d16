"""Impulse responses in files for other programs: NumPy archives and SOFA (AES69)."""

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from avcli.acoustics.responses import impulse_responses
from avcli.acoustics.surroundings import Surroundings
from avcli.formats import atomic

KINDS = (".npz", ".sofa")


def check_path(path: str) -> None:
    """Check that responses can be written to a file of this name, before any work is done.

    Raises:
        ValueError: the name has another ending than those of KINDS.
        ModuleNotFoundError: it ends in .sofa, and the package sofar is not installed.
    """
    if Path(path).suffix not in KINDS:
        raise ValueError(f"{path}: the name must end in {' or '.join(KINDS)}")
    if Path(path).suffix == ".sofa" and importlib.util.find_spec("sofar") is None:
        raise ModuleNotFoundError(f"{path} needs the package sofar (pip install sofar); .npz does not")


def write_responses(
    path: str, surroundings: Surroundings, times_s: Sequence[float], ids: Sequence[int], mouths_m: Sequence[np.ndarray]
) -> None:
    """Write the impulse responses from mouths to all microphones to a .npz or .sofa file, whole or not at all.

    Args:
        path: see `check_path`.
        surroundings: the room and the microphones.
        times_s: (k,) s, when each mouth is there.
        ids: (k,) of the people.
        mouths_m: (k, 3) m.
    """
    positions = np.array(mouths_m, dtype=float).reshape(-1, 3)
    content = {
        "rir": impulse_responses(surroundings, positions).astype(np.float32),
        "timestamp": np.array(times_s, dtype=float),
        "object_id": np.array(ids, dtype=np.int64),
        "source_position_m": positions,
        "microphone_positions_m": surroundings.microphones_m,
        "room_dimensions_m": surroundings.room_dimensions_m,
        "reflection": surroundings.reflection,
        "sample_rate_hz": np.array(surroundings.sample_rate_hz),
        "speed_of_sound_m_s": np.array(surroundings.speed_of_sound_m_s),
    }
    with atomic.replacing(path) as temporary:
        if path.endswith(".npz"):
            with open(temporary, "wb") as file:
                np.savez_compressed(file, allow_pickle=False, **content)
        else:
            _write_sofa(temporary, content)


def _write_sofa(path: str | Path, content: Mapping[str, np.ndarray]) -> None:
    """Write responses by AES69 (SingleRoomSRIR): a measurement for each mouth, a receiver for each microphone."""
    import sofar

    sofa = sofar.Sofa("SingleRoomSRIR")
    sofa.GLOBAL_Title = "Simulated impulse responses of a shoebox room"
    sofa.GLOBAL_ApplicationName = "avsim-audio"
    sofa.GLOBAL_RoomType = "shoebox"
    sofa.RoomCornerA, sofa.RoomCornerB = [0.0, 0.0, 0.0], content["room_dimensions_m"]
    sofa.Data_IR, sofa.Data_SamplingRate = content["rir"].astype(float), float(content["sample_rate_hz"])
    sofa.Data_Delay = [[0.0] * len(content["microphone_positions_m"])]
    positions, receivers = content["source_position_m"], content["microphone_positions_m"]
    sofa.SourcePosition, sofa.ListenerPosition = positions, 0 * positions
    sofa.ReceiverPosition = receivers[:, :, None]
    for name in ("SourcePosition", "ListenerPosition", "ReceiverPosition"):
        setattr(sofa, f"{name}_Type", "cartesian")
        setattr(sofa, f"{name}_Units", "metre")
    count = len(receivers)
    for name in ("ReceiverDescriptions", "EmitterDescriptions"):  # sofar 1.3 cannot write them with netCDF4 1.7.5
        sofa.delete(name)
    sofa.ReceiverView, sofa.ReceiverUp = [[[1.0], [0.0], [0.0]]] * count, [[[0.0], [0.0], [1.0]]] * count
    sofa.MeasurementDate = content["timestamp"]
    named = Path(f"{path}.sofa")  # sofar insists on this ending
    try:
        sofar.write_sofa(str(named), sofa)
        named.replace(path)
    finally:
        named.unlink(missing_ok=True)
