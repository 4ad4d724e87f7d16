"""Train the embedded detector: python train.py --out DIR [--large] [--minutes M] [--worlds DIR] [--resume]

Needs torch and the package itself; a graphics card is used where torch sees one. Some processes draw or read pictures,
one learns from them: what they draw is kept in memory and seen many times, each time turned, in another size and in
another light (augment.py), and what was learnt badly more often. A folder of worlds may grow meanwhile. Checkpoints
every two minutes; --resume goes on from the last one.
"""

import argparse
import copy
import json
import math
import multiprocessing
import os
import queue
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from augment import HEIGHT, WIDTH, Memory, another_camera, looked_at
from generate import Sample
from model import Detector, loss, targets
from renders import PANELS


def of_worlds(folder: Path, rng: np.random.Generator, memory: int) -> Iterator[tuple[str, Sample]]:
    """Yield the pictures of random worlds in a folder (worlds.py) as they appear there, and again when forgotten."""
    from backdrops import floor_coloured
    from worlds import read

    seen, count = set(), 0
    while True:
        files = sorted(folder.glob("[0-9]*[0-9].npz"))
        new = [path for path in files if path not in seen]
        if not new and count <= memory:
            time.sleep(1.0)
            continue
        new = new or files
        for index in rng.permutation(len(new)):
            seen.add(new[index])
            for one in read(new[index]):
                one.picture = floor_coloured(rng, one.picture, one.people, one.boxes, one.parts)
                count += 1
                yield "worlds" if len(one.boxes) else "empty", one


def of_others(
    seed: int, renders: float, furnished: float, panels: float, panoramas: Path | None, empty: float
) -> Iterator[tuple[str, Sample]]:
    """Yield scenes drawn on the fly: renders, drawings of generate.py, and a share of empty rooms of both."""
    from backdrops import Backdrops, floor_coloured
    from generate import Generator
    from renders import Library

    generator = Generator(seed, Backdrops(panoramas) if panoramas else None)
    rooms = Generator(seed + 1, Backdrops(panoramas), empty=True) if panoramas else None
    library = Library(seed, furnished=furnished, panels=panels)
    furniture = Library(seed + 1, each=1, people=0, pieces=(0 if furnished else 6, 18), furnished=furnished)
    chance = np.random.default_rng(seed)
    while True:
        if chance.random() < empty:
            yield "empty", rooms() if rooms and chance.random() < 0.6 else furniture()
            continue
        if chance.random() < renders:
            made = library()
            made = generator.moved(made) if panoramas and chance.random() < 0.5 else made
        else:
            made = generator()
        if made.people is not None:
            made.picture = floor_coloured(chance, made.picture, made.people, made.boxes, made.parts)
        yield "others" if len(made.boxes) else "empty", made


def of_photographs(folder: Path, seed: int, worlds: Path | None) -> Iterator[tuple[str, Sample]]:
    """Yield photographs of people in ever new positions (photographs.py), half of them in random worlds."""
    from photographs import Photographs

    photographs = Photographs(folder, seed, worlds)
    while True:
        yield "photographs", photographs()


def _drawing(made, source, *options) -> None:
    """Put what a source yields into the queue for ever."""
    import cv2

    os.nice(2)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    for one in source(*options):
        made.put(one)


def start_drawing(options: argparse.Namespace, seed: int) -> list:
    """Start the processes that draw; the queues into which each of them puts its pictures."""
    drawn = options.renders, options.furnished, options.panels, options.panoramas, 0.35
    tasks = [(of_others, seed * options.workers + k, *drawn) for k in range(options.workers)]
    if options.worlds:
        tasks.append((of_worlds, options.worlds, np.random.default_rng(seed), options.memory))
    if options.photographs:
        tasks.append((of_photographs, options.photographs, seed, options.worlds))
    spawn = multiprocessing.get_context("spawn")  # since OpenGL and CUDA do not outlive a fork
    queues = [spawn.Queue(16) for _ in tasks]
    for made, task in zip(queues, tasks, strict=True):
        spawn.Process(target=_drawing, args=(made, *task), daemon=True).start()
    return queues


def gathered(queues: list, memories: dict[str, Memory], least: int, each: int) -> None:
    """Take into memory at most `each` pictures of a source, and wait while a kind has fewer than `least`."""
    until = time.monotonic() + 120
    while True:
        for made in queues:
            for _ in range(each):
                try:
                    kind, sample = made.get_nowait()
                except queue.Empty:
                    break
                if kind in memories:
                    memories[kind].add(sample)
        if min(memory.count for memory in memories.values()) >= least:
            return
        if time.monotonic() > until:
            raise RuntimeError("no pictures came for two minutes")
        time.sleep(0.01)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--large", action="store_true", help="the large network")
    parser.add_argument("--steps", type=int, default=20_000, help="length of the learning rate's schedule")
    parser.add_argument("--minutes", type=float, help="length of the schedule in time, where it comes before --steps")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--start", type=Path, help="weights to begin with (export.py --weights)")
    parser.add_argument("--worlds", type=Path, help="folder of random worlds that worlds.py drew, or still draws")
    parser.add_argument("--photographs", type=Path, help="folder of photographs of people (photographs.py)")
    parser.add_argument("--panoramas", type=Path, help="folder of photographs all round, for rooms (backdrops.py)")
    parser.add_argument("--share", type=float, default=0.5, help="of a batch that comes from --worlds")
    parser.add_argument("--photographed", type=float, default=0.15, help="of a batch that comes from --photographs")
    parser.add_argument("--hard", type=float, default=0.2, help="of a batch that is rooms without people")
    parser.add_argument(
        "--renders", type=float, default=0.7, help="share of the other pictures that avsim-scene's renderer draws"
    )
    parser.add_argument("--furnished", type=float, default=0.35, help="share of these with a random world's furniture")
    parser.add_argument("--panels", type=float, default=PANELS, help="share of these in which something large hangs")
    parser.add_argument("--memory", type=int, default=1200, help="pictures of each kind that are kept to be seen again")
    parser.add_argument("--workers", type=int, default=1, help="processes that draw the other pictures")
    parser.add_argument("--keep", type=int, default=0, help="weights on the way that are kept, and those at first")
    return parser


def shares(options: argparse.Namespace) -> dict[str, int]:
    """How many pictures of a batch are of each kind."""
    counts = {"empty": round(options.hard * options.batch)}
    if options.worlds:
        counts["worlds"] = round(options.share * options.batch)
    if options.photographs:
        counts["photographs"] = round(options.photographed * options.batch)
    return {"others": options.batch - sum(counts.values())} | counts


class Training:
    """The network, its mean over the last steps, and what the optimizer knows."""

    def __init__(self, options: argparse.Namespace, device: torch.device):
        self.options, self.device, self.step, self.spent = options, device, 0, 0.0
        self.model = Detector(options.large).to(device, memory_format=torch.channels_last)
        if options.start:
            self.model.begin_with(torch.load(options.start, map_location=device))
        self.average = copy.deepcopy(self.model)
        self.optimizer = torch.optim.AdamW(self.model.parameters(), lr=options.rate, weight_decay=0.02)
        self._checkpoint = options.out / "checkpoint.pt"
        if options.resume:
            state = torch.load(self._checkpoint, map_location=device)
            for name in ("model", "average", "optimizer"):
                getattr(self, name).load_state_dict(state[name])
            self.step, self.spent = state["step"], state["spent"]

    @property
    def progress(self) -> float:
        """The part of the schedule that is over, by steps or by time."""
        options = self.options
        return max(self.step / options.steps, self.spent / (60 * options.minutes) if options.minutes else 0.0)

    def learn(self, taken: dict) -> tuple:
        """One step on a batch; the loss of each picture's scores, and of boxes and points."""
        warm = min(1.0, (self.step + 1) / 100)
        for group in self.optimizer.param_groups:
            cosine = 0.5 * (1 + math.cos(math.pi * min(self.progress, 1.0)))
            group["lr"] = self.options.rate * warm * (0.02 + 0.98 * cosine)
        with torch.no_grad():
            pictures, *people = looked_at(taken)
            pictures = another_camera(pictures).contiguous(memory_format=torch.channels_last)
            wanted = targets(*people, HEIGHT, WIDTH)
        with torch.autocast(self.device.type, torch.bfloat16):
            guess = self.model(pictures)
        scores, boxes, points = loss(guess.float(), *wanted)
        self.optimizer.zero_grad(set_to_none=True)
        (scores.sum() + 3.0 * boxes + 3.0 * points).backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 10.0)
        self.optimizer.step()
        self.step += 1
        self._follow()
        return scores.detach(), boxes.detach(), points.detach()

    @torch.no_grad()
    def _follow(self) -> None:
        decay = min(0.999, self.step / (self.step + 20))
        for mean, value in zip(self.average.state_dict().values(), self.model.state_dict().values(), strict=True):
            if value.dtype.is_floating_point:
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)

    def save(self) -> None:
        """Write the checkpoint that --resume goes on from."""
        state = {name: getattr(self, name).state_dict() for name in ("model", "average", "optimizer")}
        torch.save(state | {"step": self.step, "spent": self.spent}, f"{self._checkpoint}.new")
        os.replace(f"{self._checkpoint}.new", self._checkpoint)

    def keep(self, number: int) -> None:
        """Write the mean's weights alone, in half precision."""
        weights = self.average.state_dict()
        half = {name: value.half() if value.dtype.is_floating_point else value for name, value in weights.items()}
        torch.save({"average": half, "step": self.step}, self.options.out / f"kept-{number:02}.pt")


def learn(options: argparse.Namespace, device: torch.device) -> None:
    """The loop; see `_parser`."""
    training, counts = Training(options, device), shares(options)
    memories = {kind: Memory(options.memory, device) for kind, count in counts.items() if count}
    queues = start_drawing(options, options.seed * 1000 + training.step)
    started, saved, sums = time.time() - training.spent, time.time(), torch.zeros(3, device=device)
    kept = math.ceil(options.keep * training.progress)
    while training.progress < 1:
        if options.keep and training.progress >= kept / options.keep:
            training.keep(kept)
            kept += 1
        gathered(queues, memories, 4, max(1, options.batch // 8))
        # Rooms in which nobody is seen by mistake teach nothing more, so that these are drawn by what is seen there.
        drawn = {kind: memory.drawn(counts[kind], 1.0 if kind == "empty" else 0.5) for kind, memory in memories.items()}
        parts = [memories[kind].of(numbers) for kind, numbers in drawn.items()]
        scores, *others = training.learn({name: torch.cat([part[name] for part in parts]) for name in parts[0]})
        badly = (scores * options.batch + 0.02).split([len(numbers) for numbers in drawn.values()])
        for (kind, numbers), value in zip(drawn.items(), badly, strict=True):
            memories[kind].badly[numbers] = value
        sums += torch.stack([scores.sum(), *others])
        training.spent = time.time() - started
        if training.step % 50 == 0:
            stored = {kind: memory.count for kind, memory in memories.items()}
            means = [round(value, 3) for value in (sums / 50).tolist()]
            said = {"step": training.step, "s": round(training.spent), "pictures": stored}
            print(json.dumps(said | {"loss of scores, boxes, parts": means}), flush=True)
            sums.zero_()
        if time.time() - saved > 120:
            training.save()
            saved = time.time()
    training.save()
    if options.keep:
        training.keep(kept)


def main() -> None:
    options = _parser().parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    torch.backends.cudnn.benchmark = True
    learn(options, torch.device("cuda" if torch.cuda.is_available() else "cpu"))
    for process in multiprocessing.active_children():
        process.terminate()


if __name__ == "__main__":
    main()
