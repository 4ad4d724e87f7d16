"""What a sensor is: a camera, which sees the axes of bodies, or microphones, which hear mouths."""

from collections.abc import Mapping

CAMERA, MICROPHONES = "camera", "microphones"
KINDS = (CAMERA, MICROPHONES)


def sensor_kind(name: str, stated: str | None = None, sensors: Mapping[str, str] | None = None) -> tuple[str, bool]:
    """Tell what kind of sensor a name means, and whether that had to be guessed from its letters.

    Args:
        name: the sensor's name.
        stated: the kind that its record says, None where it says none.
        sensors: name -> kind, as config.json's "sensors" says.

    Returns:
        The kind, one of `KINDS`; true if neither the record nor config.json says it.
    """
    known = stated or (sensors or {}).get(name)
    if known is not None:
        return known, False
    heard = any(part in name.lower() for part in ("audio", "mic", "sound"))
    return (MICROPHONES if heard else CAMERA), True
