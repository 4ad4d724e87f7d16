"""How people move: mean-reverting constant-velocity models, one alone or several interacting ones (IMM).

A state is [x, y, vx, vy] in metres and metres per second. Height is not part of it: people walk on the floor.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

FOREVER = 1e6

Step = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Model:
    """One linear motion model, dv = -v / memory dt + noise dW, an Ornstein-Uhlenbeck process of velocity.

    Attributes:
        noise: square root of the acceleration's power spectral density, m / s^1.5.
        memory: seconds over which a velocity is forgotten; FOREVER is the nearly-constant-velocity model.
        pulse: m / s², of an acceleration that is constant within a time step instead of white (the thesis's sigma_v).
        start: m/s, standard deviation of each component of a new person's velocity, None: as in the long run.

    Source:
        Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
        sections 6.2 (white and piecewise constant acceleration) and 8.2 (models with memory).
    """

    noise: float
    memory: float = FOREVER
    pulse: float = 0.0
    start: float | None = 0.7

    def speed(self) -> float:
        """Return the standard deviation, m/s, of each component of a new person's velocity.

        >>> Model(2.0, memory=0.5, start=None).speed()
        1.0
        """
        return self.noise * math.sqrt(self.memory / 2) if self.start is None else self.start

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the transition (4, 4) and the process noise (4, 4) of dt seconds, exact for any dt.

        >>> transition, noise = Model(0.0, pulse=1.0).step(0.1)
        >>> transition[0].round(6).tolist()
        [1.0, 0.0, 0.1, 0.0]
        >>> [round(float(noise[0, 0]), 9), round(float(noise[0, 2]), 9), round(float(noise[2, 2]), 9)]
        [2.5e-05, 0.0005, 0.01]
        """
        a = np.exp(-dt / self.memory)
        if dt < 1e-3 * self.memory:  # the closed forms cancel there; series to the second order
            x = dt / self.memory
            b = dt * (1 - x / 2)
            pp, pv, vv = dt**3 / 3 * (1 - 0.75 * x), dt**2 / 2 * (1 - x), dt * (1 - x)
        else:
            tau = self.memory
            b = tau * (1 - a)
            pp = tau**2 * (dt - 2 * b + tau / 2 * (1 - a * a))
            pv = b * b / 2
            vv = tau / 2 * (1 - a * a)
        axis = self.noise**2 * np.array([[pp, pv], [pv, vv]])
        axis += self.pulse**2 * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
        return np.kron([[1.0, b], [0.0, a]], np.eye(2)), np.kron(axis, np.eye(2))


@dataclass(frozen=True)
class Motion:
    """Interacting motion models that switch as a continuous-time Markov chain.

    Attributes:
        models: M of them.
        rates: M x M, rates[i][j] switches per second from i to j (the diagonal is ignored).
        stand: number of the model of a person who stands, -1: none.
    """

    models: tuple[Model, ...]
    rates: tuple[tuple[float, ...], ...] = ((0.0,),)
    stand: int = -1

    @staticmethod
    def of(described: Mapping[str, Any]) -> "Motion":
        """Make a motion of what fitted.json says: "models" (noise, memory, start), "rates", "stand"."""
        models = tuple(
            Model(one["noise"], one.get("memory", FOREVER), start=one.get("start")) for one in described["models"]
        )
        rates = tuple(tuple(map(float, row)) for row in described["rates"])
        return Motion(models, rates, described["stand"])

    def _generator(self) -> np.ndarray:
        q = np.array(self.rates, float)
        np.fill_diagonal(q, 0.0)
        np.fill_diagonal(q, -q.sum(1))
        return q

    def stationary(self) -> np.ndarray:
        """Return the probabilities (M,) of the models in the long run."""
        q = self._generator()
        a = np.vstack([q.T, np.ones(len(q))])
        return np.linalg.lstsq(a, np.r_[np.zeros(len(q)), 1.0], rcond=None)[0].clip(1e-12)

    @cached_property
    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """A new person's models, (M,) probabilities, and velocities, (M, 2, 2) m² / s² covariances about 0."""
        return self.stationary(), np.array([model.speed() ** 2 * np.eye(2) for model in self.models])

    def step(self, dt: float) -> Step:
        """Return transitions (M, 4, 4), process noises (M, 4, 4) and switching probabilities (M, M) of dt seconds."""
        known = self._steps.get(dt)
        if known is None:
            if len(self._steps) > 256:  # time steps repeat; irregular ones must not fill the memory
                self._steps.clear()
            known = self._steps[dt] = self._computed(dt)
        return known

    @cached_property
    def _steps(self) -> dict[float, Step]:
        return {}

    def _computed(self, dt: float) -> Step:
        steps = [model.step(dt) for model in self.models]
        q = self._generator() * dt
        doublings = max(0, int(np.ceil(np.log2(max(np.abs(q).max(), 1e-9)))) + 12)
        switch = np.linalg.matrix_power(np.eye(len(q)) + q / 2**doublings, 2**doublings)
        switch = switch.clip(1e-12)
        switch /= switch.sum(1, keepdims=True)
        return np.array([f for f, _ in steps]), np.array([q for _, q in steps]), switch


# On the way a person goes straight for long; who strolls has turned lately, and soon turns again. Both move alike until
# then. "Just turned" is a model of its own because the velocity is not known yet: mixed with that of "strolling", it
# would blur both.
FITTED = Path(__file__).with_name("fitted.json")
WALKING = Motion.of(json.loads(FITTED.read_text())["motion"])
