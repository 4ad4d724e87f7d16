"""Where an array's microphones are and when its channels hear, from the delays of a voice that moves.

A bundle adjustment: positions of the microphones, delay and drift of each channel, the speed of sound, and the path of
the voice are solved for together from the delays of pairs (maximum a posteriori, robust Gauss-Newton). The path is a
chain of places and velocities, eliminated by its banded normal matrix (Schur's complement). The priors hold what delays
cannot tell: where the array is in the room, how it is turned, and how large it is.
"""

from dataclasses import dataclass

import numpy as np

from avcli.calibration.echoes import LASTING_S, LOOKS, STANDS_OUT, Echoes, Smoothed, Surfaces
from avcli.numeric import TooLittle

MOUTH_M, MOUTH_SD_M = 1.5, 0.2
"""Mean height of a mouth, m, and its standard deviation."""
ACCELERATION, UPRIGHT = 5.0, 0.2
"""m²/s³, the spectral density of a voice's acceleration along x and y, and along z. It is ten times a walker's, since
the most probable path of a narrow prior is a shorter one, and with it the whole array would shrink."""
BLOCK_S = 3.0
"""The time after which errors of delays are taken to be new ones, s."""
COARSE_S, TURN_S, FINE_S = 4e-4, 5e-5, 1e-5
"""The robust scale of a delay's error at the beginning of the fit, from where on it is estimated, and the least, s."""
LOOSE = 5.0
"""By how much the standard deviation of a surface is larger that is heard without the one opposite."""
CLEAR_SHARE, ECHOING = 0.9, 10.0
"""By sound alone: the share of delays that fit in a clear recording, and by how much the logarithm of their variance
grows with what is missing to it. Where echoes take many delays, they bend those that fit as well, all alike, and no
comparison of windows shows it. Decided on seven rooms of pyroomacoustics (examples/benchmarks/microphones.md)."""


@dataclass(frozen=True)
class Priors:
    """What is known before: standard deviations.

    Attributes:
        position_m: of each coordinate of a microphone.
        delay_s, drift: of a channel, or of each (m,).
        speed_m_s: of the speed of sound.
        clock_s: of the clock between the sound and the places that are given.
        surface_m: of the position of a surface of the room.
    """

    position_m: float = 0.04
    delay_s: float | np.ndarray = 1e-3
    drift: float | np.ndarray = 2e-5
    speed_m_s: float = 2.0
    clock_s: float = 0.0
    surface_m: float = 0.01


@dataclass(frozen=True)
class Way:
    """Where the voice was, as another sensor or a tape measure says.

    Attributes:
        times: (k,) s, ascending.
        places: (k, 3) m.
        errors: (k,) int; places with the same number share one error.
        sd_m: standard deviation of that error along each axis.
        offset_m: of the error along x, y and z that all places have in common.
    """

    times: np.ndarray
    places: np.ndarray
    errors: np.ndarray
    sd_m: float
    offset_m: tuple[float, float, float]


@dataclass(frozen=True)
class Fit:
    """An array, as the sound shows it.

    Attributes:
        positions: (m, 3) m.
        delays: (m,) s by which each channel is late at time 0, beyond what was put right before; the mean of those that
            were known best is 0.
        drifts: (m,) s/s; the same holds for them.
        speed_of_sound: m/s.
        clock: s, to add to a time of the sound to get one of the way.
        path: (n, 3) m, where the voice was in each window.
        predicted: (n, p) s, the delays of the pairs in each window.
        arrivals, echoes: (n, m) and (n, m, s) s, when each channel hears the direct sound and the echo of each surface,
            after the mean of all direct sounds.
        surfaces: (s,) m, where the surfaces are.
        clear: (m, s) by how many standard deviations of noise each echo is heard.
        covariance: of positions (3 m), delays, drifts and speed of sound, in this order.
        residual_s: robust standard deviation of a delay about the model.
        used: share of the windows' pairs that fit the model.
    """

    positions: np.ndarray
    delays: np.ndarray
    drifts: np.ndarray
    speed_of_sound: float
    clock: float
    path: np.ndarray
    predicted: np.ndarray
    arrivals: np.ndarray
    echoes: np.ndarray
    surfaces: np.ndarray
    clear: np.ndarray
    covariance: np.ndarray
    residual_s: float
    used: float

    @property
    def shape_covariance(self) -> np.ndarray:
        """Of the positions without what a rigid motion of the whole array does, (3 m, 3 m) m²."""
        size = self.positions.size
        keep = np.eye(size) - _rigid(self.positions)
        return keep @ self.covariance[:size, :size] @ keep

    @property
    def shape_sd(self) -> np.ndarray:
        """Of each microphone within the array's shape: root of the largest eigenvalue, (m,) m."""
        return _largest_sd(self.shape_covariance)

    @property
    def place_sd(self) -> np.ndarray:
        """Of the array's middle along x, y and z, (3,) m."""
        count = len(self.positions)
        mean = np.tile(np.eye(3), (1, count)) / count
        return np.sqrt(np.diag(mean @ self.covariance[: 3 * count, : 3 * count] @ mean.T))

    @property
    def position_sd(self) -> np.ndarray:
        """Of each microphone in the room: root of the largest eigenvalue, (m,) m."""
        return _largest_sd(self.covariance[: self.positions.size, : self.positions.size])

    def told(self, prior_m: float) -> float:
        """Return the share of the ways to deform the array that the sound tells twice as well as a prior in m."""
        values = np.linalg.eigvalsh(self.shape_covariance)[6:]
        return float((values < (0.5 * prior_m) ** 2).mean())

    @property
    def delay_sd(self) -> np.ndarray:
        """(m,) s."""
        count = len(self.positions)
        return np.sqrt(np.diag(self.covariance)[3 * count : 4 * count])

    @property
    def drift_sd(self) -> np.ndarray:
        """(m,) s/s."""
        count = len(self.positions)
        return np.sqrt(np.diag(self.covariance)[4 * count : 5 * count])


def _rigid(positions: np.ndarray) -> np.ndarray:
    """The projector onto small rigid motions of points (m, 3), (3 m, 3 m)."""
    away = positions - positions.mean(axis=0)
    moves = [np.tile(axis, (len(away), 1)) for axis in np.eye(3)] + [np.cross(axis, away) for axis in np.eye(3)]
    basis, sizes, _ = np.linalg.svd(np.array(moves).reshape(6, -1).T, full_matrices=False)
    basis = basis[:, sizes > 1e-9 * sizes[0]]
    return basis @ basis.T


def _largest_sd(covariance: np.ndarray) -> np.ndarray:
    count = len(covariance) // 3
    blocks = covariance.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count), :]
    return np.sqrt(np.maximum(np.linalg.eigvalsh(blocks)[:, -1], 0.0))


def adjust(
    times: np.ndarray,
    places: np.ndarray,
    delays: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    microphones: np.ndarray,
    speed_of_sound: float,
    priors: Priors | None = None,
    way: Way | None = None,
    clock: float = 0.0,
    doubt_echoes: bool = False,
    surfaces: Surfaces | None = None,
    echoes: Echoes | None = None,
) -> Fit:
    """Find the array and the path that explain the delays.

    Args:
        times: (n,) s, ascending.
        places: (n, 3) m, rough places of the voice.
        delays: (n, p, k) s, candidates for each pair's delay, arrival at its first microphone minus at its second; NaN
            where there is none.
        first, second: (p,) the microphones of each pair.
        microphones: (m, 3) m, as measured.
        speed_of_sound: m/s.
        priors: how well these are known.
        way: where the voice was, if that is known.
        clock: s, roughly, to add to a time of the sound to get one of the way.
        doubt_echoes: whether delays count for less where many of them do not fit.
        surfaces: the room's, roughly.
        echoes: what was heard of their echoes.

    Raises:
        TooLittle: too few windows have delays.

    Source: the elimination is that of B. Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000, section 6; the
    motion that of Y. Bar-Shalom et al., "Estimation with Applications to Tracking and Navigation", 2001, 6.2.2.
    """
    clear = int(np.isfinite(delays).any(axis=(1, 2)).sum())
    if clear < 8:
        raise TooLittle(f"a clear voice in {clear} windows only; record some minutes of speech or claps")
    known = priors or Priors()
    problem = _Problem(times, delays, first, second, microphones, speed_of_sound, known, way, clock, surfaces)
    problem.start(places)
    scale = COARSE_S
    for _ in range(60):
        step, residuals = problem.step(scale)
        if scale > 1.01 * TURN_S:
            scale = max(0.85 * scale, TURN_S)
            continue
        last, scale = scale, float(np.clip(_spread(residuals, scale) * problem.freedom, FINE_S, 2.0 * TURN_S))
        if step < 1e-4 and abs(scale - last) < 0.03 * last:
            break
    share = float((np.abs(residuals) < 3.0 * scale).sum()) / max(int(np.isfinite(delays).any(axis=2).sum()), 1)
    for _ in range(2):
        problem.inflation *= problem.clustered(scale)
        for _ in range(4):
            problem.step(scale)
    if doubt_echoes and share < CLEAR_SHARE:
        problem.inflation *= float(np.exp(ECHOING * (CLEAR_SHARE - share)))
        for _ in range(4):
            problem.step(scale)
    if echoes is not None:
        problem.follow(echoes, scale)
    return problem.fit(scale, share)


def _spread(residuals: np.ndarray, scale: float) -> float:
    """Return the standard deviation, s, of those residuals near 0 that are more than the even background of echoes."""
    size, inner, outer = np.abs(residuals), 4.0 * scale, 12.0 * scale
    density = ((size > inner) & (size < outer)).sum() / (outer - inner)
    near = size[size < inner]
    count = len(near) - density * inner
    if count < 0.2 * len(near) or count < 20:
        return scale
    return float(np.sqrt(max((near**2).sum() - density * inner**3 / 3.0, 0.0) / count))


class _Problem:
    """The unknowns and their normal equations.

    Global unknowns, in this order: positions (3 m), delays (m), drifts (m), speed of sound, clock, offset (3), surfaces
    (s). Local ones: place and velocity (6) in each window.
    """

    def __init__(
        self,
        times: np.ndarray,
        delays: np.ndarray,
        first: np.ndarray,
        second: np.ndarray,
        microphones: np.ndarray,
        speed: float,
        priors: Priors,
        way: Way | None,
        clock: float,
        surfaces: Surfaces | None,
    ):
        self.times, self.delays, self.first, self.second, self.way = times, delays, first, second, way
        self.middle = float(times.mean())
        count = len(microphones)
        self.count = count
        self.surfaces = surfaces or Surfaces(np.zeros(0, int), np.zeros(0))
        self.smoothed: Smoothed | None = None
        self.clear = np.zeros((count, len(self.surfaces.axis)))
        known = np.array([speed, clock, 0.0, 0.0, 0.0])
        self.mean = np.concatenate([microphones.ravel(), np.zeros(2 * count), known, self.surfaces.position])
        late, drift = (np.broadcast_to(sd, (count,)) for sd in (priors.delay_s, priors.drift))
        last = [priors.speed_m_s, max(priors.clock_s, 1e-9), *(way.offset_m if way else (1e-9,) * 3)]
        planes = np.full(len(self.surfaces.position), priors.surface_m)
        self.sd = np.concatenate([np.full(3 * count, priors.position_m), late, drift, last, planes])
        self.unknown = self.mean.copy()
        self.prior = np.diag(self.sd**-2.0)
        # What all delays have in common is heard by none of the pairs: those that are known best are 0 on average.
        for begin in (3 * count, 4 * count):
            sd = self.sd[begin : begin + count]
            rows = begin + np.flatnonzero(sd < 1.01 * sd.min())
            self.prior[np.ix_(rows, rows)] += (1e2 / sd.min()) ** 2 / len(rows)
        self.inflation = 1.0
        self.motion = _motion(times)
        # Of all pairs of m channels only m - 1 delays are independent.
        self.share = (count - 1) / len(first)
        # Residuals are smaller than errors, since each window has a place of its own.
        self.freedom = float(np.sqrt((count - 1) / max(count - 4, 1)))
        self.ways = self._on_way()
        self.offset = slice(5 * count + 2, 5 * count + 5)
        self.planes = slice(5 * count + 5, len(self.mean))
        heard = np.isfinite(delays).any(axis=(0, 2))
        self.hears = np.bincount(np.concatenate([first[heard], second[heard]]), minlength=count) > 0

    def _on_way(self) -> np.ndarray:
        """Return the information (n,) 1/m² of the given places in each window."""
        if self.way is None:
            return np.zeros(len(self.times))
        at = self.times + self.mean[5 * self.count + 1]
        known = (at >= self.way.times[0]) & (at <= self.way.times[-1])
        nearest = np.abs(at[:, None] - self.way.times).argmin(axis=1)
        known &= np.abs(at - self.way.times[nearest]) < 0.5
        _, shared, sizes = np.unique(self.way.errors[nearest[known]], return_inverse=True, return_counts=True)
        information = np.zeros(len(at))
        information[known] = 1.0 / (self.way.sd_m**2 * sizes[shared])
        return information

    def start(self, places: np.ndarray) -> None:
        """Begin from rough places (n, 3) m, smoothed robustly."""
        smooth = places.copy()
        near = np.abs(self.times[:, None] - self.times) < 0.6
        for row, some in enumerate(near):
            smooth[row] = np.median(places[some], axis=0)
        self.local = np.concatenate([smooth, np.zeros_like(smooth)], axis=1)

    def _model(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Predict the delays (n, p).

        Returns:
            delays, unit vectors (n, p, 3) from the first and from the second microphone, by how much later than the
            window's middle a pair hears, s, and the difference of the ranges, m.
        """
        count = self.count
        positions, speed = self.unknown[: 3 * count].reshape(-1, 3), self.unknown[5 * count]
        late, drift = self.unknown[3 * count : 4 * count], self.unknown[4 * count : 5 * count]
        middle = np.linalg.norm(self.local[:, None, :3] - positions, axis=2)
        # A pair hears what was said before a window's middle by its own mean travel time, not by the array's.
        before = middle.mean(axis=1, keepdims=True)
        shift = (before - 0.5 * (middle[:, self.first] + middle[:, self.second])) / speed
        at = self.local[:, None, :3] + self.local[:, None, 3:] * shift[..., None]
        one, other = at - positions[self.first], at - positions[self.second]
        far, near = np.linalg.norm(one, axis=2), np.linalg.norm(other, axis=2)
        one, other = one / np.maximum(far, 1e-6)[..., None], other / np.maximum(near, 1e-6)[..., None]
        behind = late + drift * (self.times - self.middle)[:, None]
        predicted = (far - near) / speed + behind[:, self.first] - behind[:, self.second]
        return predicted, one, other, shift, far - near

    def _jacobians(
        self, one: np.ndarray, other: np.ndarray, shift: np.ndarray, difference: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the delays to the global (n, p, g) and the local (n, p, 6) unknowns."""
        count, speed = self.count, self.unknown[5 * self.count]
        n, p = difference.shape
        row = np.arange(p)
        whole = np.zeros((n, p, len(self.unknown)))
        for axis in range(3):
            whole[:, row, 3 * self.first + axis] = -one[..., axis] / speed
            whole[:, row, 3 * self.second + axis] = other[..., axis] / speed
        whole[:, row, 3 * count + self.first] = 1.0
        whole[:, row, 3 * count + self.second] = -1.0
        elapsed = (self.times - self.middle)[:, None]
        whole[:, row, 4 * count + self.first] = elapsed
        whole[:, row, 4 * count + self.second] = -elapsed
        whole[:, :, 5 * count] = -difference / speed**2
        towards = (one - other) / speed
        return whole, np.concatenate([towards, towards * shift[..., None]], axis=2)

    def _picked(self, predicted: np.ndarray) -> np.ndarray:
        """Residuals (n, p) of the candidates nearest to the prediction; infinite where there is none."""
        away = self.delays - predicted[..., None]
        away[np.isnan(away)] = np.inf
        at = np.abs(away).argmin(axis=2)
        return np.take_along_axis(away, at[..., None], axis=2)[..., 0]

    def _equations(self, scale: float) -> tuple[np.ndarray, ...]:
        """Weighted normal equations of the windows, and the residuals (n, p) of the delays.

        Returns:
            information (g, g) and gradients (n, g) of the global unknowns, those (n, 6, 6) and (n, 6) of the local
            ones, what couples them (n, 6, g), and the residuals.
        """
        predicted, one, other, shift, difference = self._model()
        rest = self._picked(predicted)
        ratio = np.where(np.isfinite(rest), rest, 1e9) / scale
        # Geman and McClure's weight: an echo is far off and should not pull at all.
        weight = self.share / (scale**2 * self.inflation * (1.0 + (ratio / 3.0) ** 2) ** 2)
        rest = np.where(np.isfinite(rest), rest, 0.0)
        whole, local = self._jacobians(one, other, shift, difference)
        heavy, light = whole * weight[..., None], local * weight[..., None]
        g = whole.shape[2]
        information = heavy.reshape(-1, g).T @ whole.reshape(-1, g)
        gradient = np.einsum("npg,np->ng", heavy, rest)
        ll = np.matmul(light.transpose(0, 2, 1), local)
        lg = np.matmul(light.transpose(0, 2, 1), whole)
        lr = np.einsum("npl,np->nl", light, rest)
        if self.smoothed is not None:
            self._add_echoes(self.smoothed, information, gradient, ll, lr, lg)
        return information, gradient, ll, lr, lg, np.where(ratio < 1e6, ratio * scale, np.inf)

    def _echo_model(self) -> tuple[np.ndarray, ...]:
        """Predict when echoes and direct sounds arrive after the mean direct sound.

        Returns:
            delays (n, m, s) and (n, m), s; unit vectors (n, m, s, 3) from the images of the microphones, and their mean
            (n, 3) and each (n, m, 3) from the microphones; by how much later than the window's middle an echo and the
            direct sound were said together, (n, m, s) s.
        """
        count, speed = self.count, self.unknown[5 * self.count]
        positions, used = self.unknown[: 3 * count].reshape(-1, 3), self.hears / max(self.hears.sum(), 1)
        late, drift = self.unknown[3 * count : 4 * count], self.unknown[4 * count : 5 * count]
        place, velocity = self.local[:, :3], self.local[:, 3:]
        straight = place[:, None] - positions
        near = np.linalg.norm(straight, axis=2)
        straight = straight / np.maximum(near, 1e-6)[..., None]
        before, mean = near @ used, np.einsum("nmx,m->nx", straight, used)
        images = self.surfaces.mirrored(positions, self.unknown[self.planes])
        away = place[:, None, None] - images
        shift = 0.5 * (before[:, None, None] - np.linalg.norm(away, axis=3)) / speed
        away = away + velocity[:, None, None] * shift[..., None]
        far = np.linalg.norm(away, axis=3)
        reference = before[:, None, None] + (mean * velocity).sum(axis=1)[:, None, None] * shift
        behind = late + drift * (self.times - self.middle)[:, None]
        behind = behind - (behind @ used)[:, None]
        direct = (near - before[:, None]) / speed + behind
        return (far - reference) / speed + behind[..., None], direct, away / far[..., None], mean, straight, shift

    def follow(self, echoes: Echoes, scale: float) -> None:
        """Take in echoes, from smoothed correlations to sharp ones."""
        for smoothing, least in LOOKS:
            self._look(Smoothed(echoes, smoothing, least), scale)
        self._look(Smoothed(echoes, 0.0, STANDS_OUT, LASTING_S, self.echoes_scatter()), scale)

    def _look(self, smoothed: Smoothed, scale: float) -> None:
        """Follow the surfaces that are heard where they are expected."""
        smoothed.trust(*self._echo_model()[:2])
        self.smoothed = smoothed
        for _ in range(5):
            self.step(scale)

    def echoes_scatter(self) -> float:
        """Return by how much the slopes at echoes vary more from time to time than noise does, at least 1."""
        if self.smoothed is None:
            return 1.0
        delays, direct, *_ = self._echo_model()
        rest, weight, _ = self.smoothed.told(delays, direct)
        _, inverse = np.unique(np.floor(self.times / BLOCK_S), return_inverse=True)
        pull, told = np.zeros((2, inverse.max() + 1, *rest.shape[1:]))
        np.add.at(pull, inverse, weight * rest)
        np.add.at(told, inverse, weight)
        used = told > 0.0
        return max(1.0, float(np.mean(pull[used] ** 2 / told[used]))) if used.any() else 1.0

    def _add_echoes(
        self,
        smoothed: Smoothed,
        information: np.ndarray,
        gradient: np.ndarray,
        ll: np.ndarray,
        lr: np.ndarray,
        lg: np.ndarray,
    ) -> None:
        """Add what the echoes tell to the normal equations."""
        count, speed, g = self.count, self.unknown[5 * self.count], len(self.unknown)
        delays, direct, away, mean, straight, shift = self._echo_model()
        rest, weight, self.clear = smoothed.told(delays, direct)
        n, m, s = delays.shape
        used, one, row = self.hears / max(self.hears.sum(), 1), np.arange(m), np.arange(s)
        whole = np.zeros((n, m, s, g))
        reference = (straight * used[:, None]).reshape(n, -1) / speed
        whole[..., : 3 * count] = reference[:, None, None]
        turned = away.copy()
        turned[:, :, row, self.surfaces.axis] *= -1.0
        for axis in range(3):
            whole[:, one, :, 3 * one + axis] -= turned[..., axis].transpose(1, 0, 2) / speed
        elapsed = self.times - self.middle
        mine = np.eye(m) - used
        whole[..., 3 * count : 4 * count] = mine[:, None]
        whole[..., 4 * count : 5 * count] = mine[:, None] * elapsed[:, None, None, None]
        whole[..., 5 * count] = -delays / speed
        whole[:, :, row, 5 * count + 5 + row] = -2.0 * away[:, :, row, self.surfaces.axis] / speed
        towards = (away - mean[:, None, None]) / speed
        local = np.concatenate([towards, towards * shift[..., None]], axis=3).reshape(n, m * s, 6)
        every, weight, rest = whole.reshape(n, m * s, g), weight.reshape(n, -1), rest.reshape(n, -1)
        heavy, light = every * weight[..., None], np.swapaxes(local * weight[..., None], 1, 2)
        information += heavy.reshape(-1, g).T @ every.reshape(-1, g)
        gradient += np.einsum("npg,np->ng", heavy, rest)
        ll += np.matmul(light, local)
        lg += np.matmul(light, every)
        lr += np.einsum("nlp,np->nl", light, rest)

    def _local_priors(self, ll: np.ndarray, lr: np.ndarray, lg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Add what is known of mouths and of the way; return what that adds to the global information and gradient."""
        level = MOUTH_SD_M**-2.0 / len(self.times)
        ll[:, 2, 2] += level
        lr[:, 2] += level * (MOUTH_M - self.local[:, 2])
        g = len(self.unknown)
        information, gradient = np.zeros((g, g)), np.zeros(g)
        if self.way is None:
            return information, gradient
        at = self.times + self.unknown[5 * self.count + 1] - self._travel()
        here, ahead = self._along(at), self._along(at + 0.05)
        rows = slice(5 * self.count + 1, 5 * self.count + 5)
        J = np.zeros((len(at), 3, 4))  # of place - offset - way(clock) to clock and offset
        J[:, :, 0] = -(ahead - here) / 0.05
        J[:, :, 1:] = -np.eye(3)
        rest = here + self.unknown[self.offset] - self.local[:, :3]
        w = self.ways
        for axis in range(3):
            ll[:, axis, axis] += w
        lr[:, :3] += w[:, None] * rest
        lg[:, :3, rows] += w[:, None, None] * J
        information[rows, rows] = np.einsum("n,nai,naj->ij", w, J, J)
        gradient[rows] = np.einsum("n,nai,na->i", w, J, rest)
        return information, gradient

    def _travel(self) -> np.ndarray:
        positions = self.unknown[: 3 * self.count].reshape(-1, 3)
        return np.linalg.norm(self.local[:, None, :3] - positions, axis=2).mean(axis=1) / self.unknown[5 * self.count]

    def _along(self, at: np.ndarray) -> np.ndarray:
        assert self.way is not None
        return np.stack([np.interp(at, self.way.times, self.way.places[:, axis]) for axis in range(3)], axis=1)

    def _solved(self, scale: float) -> tuple[np.ndarray, ...]:
        """Eliminate the local unknowns: reduced information (g, g) and gradient (g,), and what leads back to them."""
        from scipy.linalg import solveh_banded

        information, gradients, ll, lr, lg, rest = self._equations(scale)
        data = information.copy()
        blocks, coupling, direct = ll.copy(), lg.copy(), lr.copy()
        more, pull = self._local_priors(ll, lr, lg)
        n, g = len(self.times), len(self.unknown)
        banded, smooth = _banded(ll, self.motion, self.local)
        right = np.concatenate([lg.reshape(6 * n, g), (lr + smooth).reshape(6 * n, 1)], axis=1)
        solved = solveh_banded(banded, right, lower=True)
        Z, z = solved[:, :g], solved[:, g]
        self.prior[self.planes, self.planes] = np.diag(self._surfaces_known())
        total = information + self.prior + more - lg.reshape(6 * n, g).T @ Z
        reduced = gradients.sum(axis=0) + pull - self.prior @ (self.unknown - self.mean)
        reduced = reduced - lg.reshape(6 * n, g).T @ z
        return total, reduced, Z, z, rest, data, gradients, blocks, coupling, direct

    def _surfaces_known(self) -> np.ndarray:
        """Return the information (s,) 1/m² that is given on the surfaces.

        Of one that is heard without the one opposite nothing shows whether the room is as it is given: it is believed
        little in the end. Nor should a surface pull that is far from where it is given, nor two in a room of another
        size.
        """
        axis, sd = self.surfaces.axis, self.sd[self.planes].copy()
        if self.smoothed is not None and self.smoothed.lasting:
            heard = (self.clear > 0.0).any(axis=0)
            alone = np.bincount(axis[heard], minlength=3)[axis] < 2
            sd[alone] *= LOOSE
        apart = self.unknown[self.planes] - self.mean[self.planes]
        size = np.array([np.ptp(apart[axis == across]) for across in axis])
        far = np.maximum(np.abs(apart), size / np.sqrt(2.0)) / sd
        return 1.0 / (sd * (1.0 + (far / 3.0) ** 2)) ** 2

    def step(self, scale: float) -> tuple[float, np.ndarray]:
        """Take one step; return its largest movement of a microphone, m, and the residuals of the delays, s."""
        total, reduced, Z, z, rest, *_ = self._solved(scale)
        change = np.linalg.solve(total, reduced)
        local = (z - Z @ change).reshape(-1, 6)
        far = np.linalg.norm(local[:, :3], axis=1, keepdims=True)
        self.unknown = self.unknown + change
        self.local = self.local + local / np.maximum(far / 0.5, 1.0)
        return float(np.abs(change[: 3 * self.count]).max()), rest[np.isfinite(rest)]

    def clustered(self, scale: float) -> float:
        """Return by how much errors that last make the delays' information smaller, at least 1.

        Source: the cluster estimator of K.-Y. Liang and S. L. Zeger, Biometrika 73, 1986, as one factor.
        """
        _, _, Z, _, _, data, gradients, blocks, coupling, direct = self._solved(scale)
        n, g = len(self.times), len(self.unknown)
        back = Z.reshape(n, 6, g)
        score = gradients - np.einsum("nlg,nl->ng", back, direct)
        cross = np.einsum("nlg,nlh->gh", back, coupling)
        fisher = data - cross - cross.T + np.einsum("nlg,nlk,nkh->gh", back, blocks, back)
        values, vectors = np.linalg.eigh(fisher * np.outer(self.sd, self.sd))
        told = values > 4.0  # what the sound tells better than the priors
        if not told.any():
            return 1.0
        block = np.floor((self.times - self.times[0]) / BLOCK_S).astype(int)
        _, inverse = np.unique(block, return_inverse=True)
        sums = np.zeros((inverse.max() + 1, g))
        np.add.at(sums, inverse, score)
        sums = (sums * self.sd) @ vectors[:, told]
        count = len(sums)
        factor = float(np.mean((sums**2).sum(axis=0) / values[told])) * count / max(count - 1, 1)
        return max(factor, 1.0 / self.inflation)

    def fit(self, scale: float, share: float) -> Fit:
        """Return what was found."""
        total = self._solved(scale)[0]
        count = self.count
        covariance = np.linalg.inv(total)
        covariance = 0.5 * (covariance + covariance.T)
        # Delays are stated at time 0.
        begin = np.eye(len(covariance))
        begin[3 * count : 4 * count, 4 * count : 5 * count] = -self.middle * np.eye(count)
        covariance = begin @ covariance @ begin.T
        late, drift = self.unknown[3 * count : 4 * count], self.unknown[4 * count : 5 * count]
        echoes, direct, *_ = self._echo_model()
        return Fit(
            positions=self.unknown[: 3 * count].reshape(-1, 3),
            delays=late - self.middle * drift,
            drifts=drift,
            speed_of_sound=float(self.unknown[5 * count]),
            clock=float(self.unknown[5 * count + 1]),
            path=self.local[:, :3],
            predicted=self._model()[0],
            arrivals=direct,
            echoes=echoes,
            surfaces=self.unknown[self.planes],
            clear=self.clear,
            covariance=covariance[: 5 * count + 1, : 5 * count + 1],
            residual_s=scale,
            used=share,
        )


def _motion(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transitions (n - 1, 6, 6) between windows and the information (n - 1, 6, 6) of each step."""
    gap = np.maximum(np.diff(times), 1e-3)
    F = np.tile(np.eye(6), (len(gap), 1, 1))
    F[:, :3, 3:] = gap[:, None, None] * np.eye(3)
    density = np.array([ACCELERATION, ACCELERATION, UPRIGHT])
    information = np.zeros((len(gap), 6, 6))
    for axis in range(3):
        a, b, c = gap**3 / 3, gap**2 / 2, gap
        det = (a * c - b * b) * density[axis]
        information[:, axis, axis], information[:, axis + 3, axis + 3] = c / det, a / det
        information[:, axis, axis + 3] = information[:, axis + 3, axis] = -b / det
    return F, information


def _banded(ll: np.ndarray, motion: tuple[np.ndarray, np.ndarray], local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put local blocks (n, 6, 6) and the motion into a lower banded matrix (12, 6 n); return the motion's pull too."""
    F, Q = motion
    n = len(ll)
    diagonal, pull = ll + 1e-6 * np.eye(6), np.zeros((n, 6))
    diagonal[0, 3:, 3:] += np.eye(3)  # people walk at about 1 m/s
    pull[0, 3:] -= local[0, 3:]
    FQ = np.matmul(F.transpose(0, 2, 1), Q)
    diagonal[:-1] += np.matmul(FQ, F)
    diagonal[1:] += Q
    below = -np.matmul(Q, F)  # (n - 1, 6, 6), rows of the later window
    miss = local[1:] - np.einsum("nij,nj->ni", F, local[:-1])
    pull[1:] -= np.einsum("nij,nj->ni", Q, miss)
    pull[:-1] += np.einsum("nij,nj->ni", FQ, miss)
    banded = np.zeros((12, 6 * n))
    columns = 6 * np.arange(n)
    for i in range(6):
        for j in range(6):
            if i >= j:
                banded[i - j, columns + j] = diagonal[:, i, j]
            banded[6 + i - j, columns[:-1] + j] = below[:, i, j]
    return banded, pull
