"""Which pictures of a long film are quick to reach: those soon after a key frame, the others need all before them."""

_BACK = 18
"""Frames after a key frame that OpenCV's reader comes to most quickly: it goes back by 16 before it looks for one."""
_LEAST = 30
"""Pictures that must be quick to reach; of a film with fewer all frames are decoded."""


def quick_frames(name: str, apart: float) -> list[int] | None:
    """Numbers of frames soon after key frames, at least `apart` frames from each other; None where they are too few.

    The packets of the film are read, but not decoded, which takes milliseconds a minute.

    Args:
        name: of a film.
        apart: frames.
    """
    import cv2

    packets = cv2.VideoCapture(name, cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    found: list[int] = []
    frame = 0
    while packets.isOpened() and packets.grab():
        if packets.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME) and (not found or frame + _BACK >= found[-1] + apart):
            found.append(frame + _BACK)
        frame += 1
    packets.release()
    found = [each for each in found if each < frame]
    return found if len(found) >= _LEAST else None
