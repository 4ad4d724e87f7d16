"""How people move: mean-reverting constant-velocity models, one alone or several interacting ones (IMM).

A state is [x, y, vx, vy] in metres and metres per second. Height is not part of it: people walk on the floor.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

FOREVER = 1e6


@dataclass(frozen=True)
class Model:
    """One linear motion model, dv = -v / memory dt + noise dW (Bar-Shalom, Li and Kirubarajan 2001, sections 6.2, 8.2).

    noise: square root of the acceleration's power spectral density, m / s^1.5.
    memory: seconds over which a velocity is forgotten; FOREVER is the nearly-constant-velocity model.
    pulse: m / s^2, of an acceleration that is constant within a time step instead of white (the thesis's sigma_v).
    """

    noise: float
    memory: float = FOREVER
    pulse: float = 0.0

    def step(self, dt):
        """The transition of one time step.

        dt: seconds. Returns ((4, 4) transition, (4, 4) process noise).
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

    models: M of them. rates: M x M, rates[i][j] switches per second from i to j (the diagonal is ignored). turn, stand:
    numbers of the models of who is turning and of who stands, -1: none.
    """

    models: tuple
    rates: tuple = ((0.0,),)
    turn: int = -1
    stand: int = -1

    def _generator(self):
        q = np.array(self.rates, float)
        np.fill_diagonal(q, 0.0)
        np.fill_diagonal(q, -q.sum(1))
        return q

    def stationary(self):
        """Probabilities of the models in the long run, (M,)."""
        q = self._generator()
        a = np.vstack([q.T, np.ones(len(q))])
        return np.linalg.lstsq(a, np.r_[np.zeros(len(q)), 1.0], rcond=None)[0].clip(1e-12)

    @lru_cache(maxsize=256)  # noqa: B019 (a handful of frozen motions, and time steps repeat)
    def step(self, dt):
        """Transitions of one time step.

        dt: seconds. Returns ((M, 4, 4) transitions, (M, 4, 4) process noises, (M, M) switching probabilities).
        """
        steps = [model.step(dt) for model in self.models]
        q = self._generator() * dt
        doublings = max(0, int(np.ceil(np.log2(max(np.abs(q).max(), 1e-9)))) + 12)
        switch = np.linalg.matrix_power(np.eye(len(q)) + q / 2**doublings, 2**doublings)
        switch = switch.clip(1e-12)
        switch /= switch.sum(1, keepdims=True)
        return np.array([f for f, _ in steps]), np.array([q for _, q in steps]), switch


# Straight on for long; just turned; turned a while ago; turning, to anywhere at any pace; standing. Who has just turned
# has a model of his own because his velocity is not known yet: mixed with that of who walks on, it would blur both. The
# numbers are near those of greatest likelihood for people who walk straight, turn back and stroll between places.
WALKING = Motion(
    (Model(0.01), Model(0.07), Model(0.01), Model(2.3, 0.19), Model(1.5, 0.01)),
    (
        (0.0, 0.0, 0.0, 0.015, 0.15),
        (0.0, 0.0, 2.2, 0.155, 0.055),
        (1.4, 0.0, 0.0, 0.155, 0.055),
        (0.0, 6.3, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 1.65, 0.0),
    ),
    turn=3,
    stand=4,
)
