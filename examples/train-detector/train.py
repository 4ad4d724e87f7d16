"""Train the embedded detector: python train.py --out DIR [--steps N] [--resume] [--renders SHARE] [--worlds DIR]

Needs torch and the package itself. Checkpoints every two minutes; --resume goes on from the last one, with another
--steps if need be. One process draws pictures, one learns from them, each with one thread, and the same seed gives the
same pictures in the same order. A graphics card is used where torch sees one; then let --workers draw.
"""

import argparse
import copy
import itertools
import json
import math
import multiprocessing
import os
import time
from pathlib import Path

import numpy as np
import torch
from model import Detector, loss, targets
from renders import PANELS


def of_worlds(folder: Path, rng: np.random.Generator):
    """Yield looks at the pictures of the random worlds in a folder (worlds.py), in random order, for ever."""
    from worlds import cut, read

    while files := sorted(folder.glob("[0-9]*[0-9].npz")):
        for index in rng.permutation(len(files)):
            yield from (cut(rng, one) for one in read(files[index]))
    raise FileNotFoundError(f"{folder}: no worlds; draw some with worlds.py")


def pictures(
    queue, seed: int, batch: int, renders: float, furnished: float, panels: float, worlds, share: float, panoramas
) -> None:
    """Put batches of pictures and targets into the queue for ever."""
    import cv2
    from backdrops import Backdrops, floor_coloured
    from generate import HEIGHT, WIDTH, Generator, _flipped

    os.nice(2)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    generator = Generator(seed, Backdrops(panoramas) if panoramas else None)
    library = None
    if renders:
        from renders import Library

        library = Library(seed, furnished=furnished, panels=panels)
    drawn = of_worlds(worlds, generator.rng) if worlds else None

    def coloured(one):
        if one.people is not None:
            one.picture = floor_coloured(generator.rng, one.picture, one.people, one.boxes, one.parts)
        return one

    def sample():
        if drawn and generator.rng.random() < share:
            return _flipped(generator.rng, next(drawn))
        if library and generator.rng.random() < renders:
            made = library()
        else:
            return generator()
        return generator.moved(made) if panoramas and generator.rng.random() < 0.5 else made

    while True:
        samples = [coloured(sample()) for _ in range(batch)]
        maps = [targets(s.boxes, s.parts, s.anchors, s.visible, HEIGHT, WIDTH) for s in samples]
        images = np.stack([s.picture for s in samples])
        queue.put((images, [torch.stack(item).numpy() for item in zip(*maps, strict=True)]))


def deceptive_rooms(
    queue, seed: int, weights: Path, checkpoint: Path, furnished: float, worlds, panoramas, least: float = 0.15
) -> None:
    """Put rooms without people in which the network sees somebody into the queue, for ever.

    The rooms are photographed, rendered and full of furniture, or empty random worlds; the network is that of the last
    checkpoint, and of `weights` before there is one.
    """
    import cv2
    from backdrops import Backdrops
    from generate import HEIGHT, WIDTH, Generator, _flipped
    from renders import Library

    os.nice(2)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    network, known = Detector().eval(), None
    library = Library(seed, each=1, people=0, pieces=(0 if furnished else 6, 18), furnished=furnished)
    generator = Generator(seed, Backdrops(panoramas), empty=True) if panoramas else None
    sources = [generator] * 5 * bool(generator) + [library] * 3
    if worlds:
        drawn = of_worlds(worlds, library.rng)

        def empty_world():
            found = next((one for one in itertools.islice(drawn, 50) if not len(one.boxes)), None)
            return _flipped(library.rng, found) if found else library()

        sources += [empty_world] * 5
    empty = [item.numpy() for item in targets([], [], [], [], HEIGHT, WIDTH)]
    while True:
        written = checkpoint.stat().st_mtime if checkpoint.exists() else 0.0
        if written != known:
            state = torch.load(checkpoint)["average"] if written else torch.load(weights)
            network.load_state_dict({name: value.float() for name, value in state.items()})
            known = written
        picture = sources[library.rng.integers(len(sources))]().picture
        with torch.no_grad():
            maps = network(torch.from_numpy(picture).permute(2, 0, 1)[None].float().div_(255))
        if torch.sigmoid(maps[:, 0]).max() > least:
            queue.put((picture, empty))


def mirrored(chance, image, maps) -> tuple:
    """A picture and its maps as they are, or mirrored left to right, top to bottom, or both."""
    heat, negative, regression, weight = maps
    for axis, near, far, offsets in ((1, 0, 2, [4, 6, 8]), (0, 1, 3, [5, 7, 9])):
        if chance.random() < 0.5:
            image = np.flip(image, axis)
            heat, negative, weight = (np.flip(item, axis) for item in (heat, negative, weight))
            regression = np.flip(regression, axis + 1).copy()
            regression[[near, far]] = regression[[far, near]]
            regression[offsets] *= -1
    return image, (heat, negative, regression, weight)


def another_camera(chance, image: np.ndarray) -> np.ndarray:
    """A picture as a camera of another colour, contrast, sharpness and noise shows it, or as it is."""
    import cv2

    if chance.random() < 0.65:
        levels = np.arange(256) / 255
        bent = levels ** np.exp(chance.normal(0, 0.35))
        cast = np.exp(chance.normal(0, 0.16, 3) + chance.normal(-0.25, 0.45))
        haze = chance.uniform(0, 0.2)
        table = cast * (bent + haze * (1 - bent))[:, None]
        image = cv2.LUT(image, np.rint(255 * np.clip(table, 0, 1)).astype(np.uint8)[:, None])
        colourful = chance.uniform(0.15, 1.2)
        image = cv2.transform(image, colourful * np.eye(3) + (1 - colourful) * np.full((3, 3), 1 / 3))
    if chance.random() < 0.4:
        height, width = image.shape[:2]
        small = cv2.resize(image, None, fx=(f := chance.uniform(0.35, 0.9)), fy=f, interpolation=cv2.INTER_AREA)
        image = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    if chance.random() < 0.3:
        noise = cv2.randn(np.empty(image.shape, np.int16), (0, 0, 0), (chance.uniform(1, 8),) * 3)
        image = cv2.add(image, noise, dtype=cv2.CV_8U)
    return image


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=20_000, help="length of the learning rate's schedule")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rate", type=float, default=3e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--start", type=Path, help="weights to begin with (export.py --weights)")
    parser.add_argument(
        "--renders", type=float, default=0.6, help="share of pictures that avsim-scene's renderer draws"
    )
    parser.add_argument("--furnished", type=float, default=0.0, help="share of these with a random world's furniture")
    parser.add_argument("--panels", type=float, default=PANELS, help="share of these in which something large hangs")
    parser.add_argument(
        "--hard", type=int, default=0, help="of a batch, how many are empty rooms in which --start sees somebody"
    )
    parser.add_argument("--worlds", type=Path, help="folder of random worlds that worlds.py drew")
    parser.add_argument("--share", type=float, default=0.5, help="of the pictures that come from --worlds")
    parser.add_argument("--panoramas", type=Path, help="folder of photographs all round, for rooms (backdrops.py)")
    parser.add_argument("--minutes", type=float, help="length of the schedule in time, where it comes before --steps")
    parser.add_argument("--workers", type=int, default=1, help="processes that draw")
    parser.add_argument("--echo", type=int, default=6, help="how often a picture is learnt from")
    parser.add_argument("--memory", type=int, default=2400, help="pictures that are kept for it")
    options = parser.parse_args()
    if options.hard and not options.start:
        parser.error("--hard wants --start")
    options.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model = Detector().to(device, memory_format=torch.channels_last)
    average = copy.deepcopy(model)
    optimizer = torch.optim.AdamW(model.parameters(), lr=options.rate, weight_decay=0.02)
    step, spent = 0, 0.0
    if options.start:
        weights = torch.load(options.start, map_location=device)
        for network in (model, average):
            network.load_state_dict({name: value.float() for name, value in weights.items()})
    checkpoint = options.out / "checkpoint.pt"
    if options.resume:
        state = torch.load(checkpoint, map_location=device)
        model.load_state_dict(state["model"])
        average.load_state_dict(state["average"])
        optimizer.load_state_dict(state["optimizer"])
        step, spent = state["step"], state["spent"]
    queue = multiprocessing.Queue(4)
    for number in range(options.workers):
        seed = (options.seed * 1000 + step) * options.workers + number
        drawing = (
            queue, seed, options.batch, options.renders, options.furnished, options.panels, options.worlds,
            options.share, options.panoramas,
        )  # fmt: skip
        multiprocessing.Process(target=pictures, args=drawing, daemon=True).start()
    if options.hard:
        rooms = multiprocessing.Queue(64)
        furniture = options.furnished, options.worlds, options.panoramas
        mining = rooms, options.seed * 1000 + step, options.start, checkpoint, *furniture
        multiprocessing.Process(target=deceptive_rooms, args=mining, daemon=True).start()
    started, saved, sums = time.time() - spent, time.time(), np.zeros(3)
    chance, memory = np.random.default_rng([options.seed, step]), []
    badly, deceptive = [], []
    progress = step / options.steps
    while progress < 1:
        warm = min(1.0, (step + 1) / 100)
        for group in optimizer.param_groups:
            group["lr"] = options.rate * warm * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))
        # Drawing costs as much as learning: each picture is seen `echo` times, mirrored otherwise, among others.
        if step % options.echo == 0 or len(memory) < 60 * options.batch:
            images, maps = queue.get()
            memory += [(image, [item[k] for item in maps]) for k, image in enumerate(images)]
            badly += [max(badly, default=1.0)] * options.batch
            del memory[: -options.memory], badly[: -options.memory]
        if options.hard and (step % 4 == 0 or len(deceptive) < 30):
            deceptive.append(rooms.get())
        # What was learnt badly comes more often (hard example mining, Shrivastava et al., 2016), but not by itself.
        odds = np.sqrt(badly)
        drawn = chance.choice(len(memory), options.batch - options.hard, p=odds / odds.sum())
        chosen = [memory[k] for k in drawn]
        if options.hard:
            chosen += [deceptive[k] for k in chance.integers(len(deceptive), size=options.hard)]
        chosen = [mirrored(chance, *item) for item in chosen]
        images = np.stack([another_camera(chance, image) for image, _ in chosen])
        maps = [np.stack(item) for item in zip(*(item for _, item in chosen), strict=True)]
        batch = torch.from_numpy(images).to(device).permute(0, 3, 1, 2).float().div_(255)
        batch = batch.contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16):
            guess = model(batch)
        parts = loss(guess.float(), *(torch.from_numpy(item).to(device) for item in maps))
        for k, score in zip(drawn, parts[0].tolist(), strict=False):  # the last are the deceptive rooms
            badly[k] = score + 0.02
        parts = parts[0].sum(), *parts[1:]
        total = parts[0] + 3.0 * parts[1] + 3.0 * parts[2]
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimizer.step()
        step += 1
        decay = min(0.999, step / (step + 20))
        with torch.no_grad():
            for mean, value in zip(average.state_dict().values(), model.state_dict().values(), strict=True):
                if value.dtype.is_floating_point:
                    mean.lerp_(value, 1 - decay)
                else:
                    mean.copy_(value)
        sums += [float(part.detach()) for part in parts]
        spent = time.time() - started
        progress = max(step / options.steps, spent / (60 * options.minutes) if options.minutes else 0.0)
        if step % 50 == 0:
            print(json.dumps({"step": step, "s": round(spent), "cpu_s": round(time.process_time()),
                              "loss of scores, boxes, parts": (sums / 50).round(3).tolist()}), flush=True)  # fmt: skip
            sums[:] = 0
        if time.time() - saved > 120 or progress >= 1:
            state = {"model": model.state_dict(), "average": average.state_dict(), "optimizer": optimizer.state_dict()}
            torch.save(state | {"step": step, "spent": spent}, f"{checkpoint}.new")
            os.replace(f"{checkpoint}.new", checkpoint)
            saved = time.time()
    for process in multiprocessing.active_children():
        process.terminate()


if __name__ == "__main__":
    main()
