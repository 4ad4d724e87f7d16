import doctest
import json
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import avcli.lens
from avcli import pose
from avcli.lens import (
    Angular,
    BrownConrady,
    Division,
    DoubleSphere,
    ExtendedUnified,
    FourTerms,
    KannalaBrandt,
    Rational,
    TangentialBrownConrady,
    TangentialKannalaBrandt,
    Unified,
    lens_config,
    name_of,
    shader,
    variants,
)
from avcli.lens.radial import fold_of_odd_polynomial, odd_polynomial

REAL = KannalaBrandt(862.27, 862.70, 1049.47, 552.76, -0.0269, -0.0038, 0.0016, -0.0006)
WIDE = KannalaBrandt(350.0, 352.0, 960.3, 541.7, 0.02, -0.006, 0.001, -0.0001)  # images well past 110 degrees
BENT = KannalaBrandt(400.0, 400.0, 500.0, 400.0, 0.5, -0.3, 0.2, -0.05)  # plain Newton fails on a third of its field
VIRTUAL = BrownConrady(596.43, 596.43, 960.0, 540.0, -0.2)
BARREL = BrownConrady(800.0, 790.0, 950.0, 530.0, -0.25, 0.08, -0.02, 0.003)
LISTING = Division(596.43, 596.43, 960.0, 540.0, -0.2)


@dataclass(frozen=True)
class Equisolid(FourTerms, Angular):
    """The equal-area fisheye, written as CONTRIBUTING.md says, to hold that a lens is one class and one table entry."""

    text = "the equal-area fisheye"

    @cached_property
    def theta_max(self) -> float:
        return 2 * math.asin(min(fold_of_odd_polynomial(*self.radial_terms), 2.0) / 2)

    def _radius(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        m, slope = odd_polynomial(2 * np.sin(s / 2), *self.radial_terms)
        return m, slope * np.cos(s / 2)

    def _by_coefficients(self, s: np.ndarray) -> Sequence[np.ndarray]:
        return [(2 * np.sin(s / 2)) ** n for n in (3, 5, 7, 9)]


EQUAL_AREA = Equisolid(600.0, 600.0, 960.0, 540.0)
BENT_AREA = Equisolid(600.0, 610.0, 960.0, 540.0, -0.05, 0.01)
ASKEW = TangentialKannalaBrandt(862.27, 862.70, 1049.47, 552.76, -0.0269, -0.0038, 0.0016, -0.0006, 1e-3, -5e-4)
SKEWED = TangentialKannalaBrandt(500.0, 510.0, 960.0, 540.0, -0.02, 0.0, 0.0, 0.0, 0.004, 0.006)
PRISM = TangentialKannalaBrandt(390.0, 391.0, 955.0, 545.0, 0.1, 0.03, 0.0, 0.0, 0.013, 0.004, -0.009, -0.03)
FOLDED = replace(PRISM, k1=-0.1, k2=-0.02)
OPENCV5 = TangentialBrownConrady(800.0, 790.0, 950.0, 530.0, -0.25, 0.08, -0.02, 0.003, 1e-3, 2e-3)
OPENCV8 = Rational(900.0, 905.0, 955.0, 545.0, 0.4, 0.03, 0.001, 0.6, 0.1, 0.005, 1e-3, -8e-4)
UNTURNED = Rational(900.0, 905.0, 955.0, 545.0, 0.4, 0.03, 0.001, 0.6, 0.1, 0.005)
STEREOGRAPHIC = Unified(700.0, 702.0, 955.0, 545.0, 0.5)
ROUND = Unified(400.0, 402.0, 955.0, 545.0, 0.8)
FLAT = Unified(700.0, 702.0, 955.0, 545.0, 0.2)
EXTENDED = ExtendedUnified(700.0, 702.0, 955.0, 545.0, 0.62, 1.1)
DOUBLE = DoubleSphere(500.0, 502.0, 955.0, 545.0, -0.2, 0.59)
FAR = DoubleSphere(700.0, 702.0, 955.0, 545.0, 0.3, 0.45)
TURNED = [ASKEW, SKEWED, PRISM, FOLDED, OPENCV5, OPENCV8]
EXAMPLES = [
    *(REAL, WIDE, BENT, VIRTUAL, BARREL, LISTING, EQUAL_AREA, BENT_AREA, UNTURNED),
    *(STEREOGRAPHIC, ROUND, FLAT, EXTENDED, DOUBLE, FAR, *TURNED),
]


def rays(theta, phi):
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def exact_kb_angle(x, y, z):
    return mpmath.atan2(mpmath.hypot(mpmath.mpf(x), mpmath.mpf(y)), mpmath.mpf(z))


def exact_kb_pixel(lens, point):
    with mpmath.workdps(40):
        x, y, z = (mpmath.mpf(float(c)) for c in point)
        theta = exact_kb_angle(x, y, z)
        d = theta + sum(
            mpmath.mpf(k) * theta ** (2 * i + 3) for i, k in enumerate((lens.k1, lens.k2, lens.k3, lens.k4))
        )
        r = mpmath.hypot(x, y)
        return [float(lens.fx * d * x / r + lens.cx), float(lens.fy * d * y / r + lens.cy)]


def exact_kb_ray(lens, pixel):
    with mpmath.workdps(40):
        mx = (mpmath.mpf(float(pixel[0])) - mpmath.mpf(lens.cx)) / mpmath.mpf(lens.fx)
        my = (mpmath.mpf(float(pixel[1])) - mpmath.mpf(lens.cy)) / mpmath.mpf(lens.fy)
        m = mpmath.hypot(mx, my)
        ks = [mpmath.mpf(k) for k in (lens.k1, lens.k2, lens.k3, lens.k4)]

        def excess(t):
            return t + sum(k * t ** (2 * i + 3) for i, k in enumerate(ks)) - m

        theta = mpmath.findroot(excess, (mpmath.mpf(0), mpmath.mpf(lens.theta_max)), solver="anderson")
        return [float(mpmath.sin(theta) * mx / m), float(mpmath.sin(theta) * my / m), float(mpmath.cos(theta))]


@pytest.mark.parametrize("lens", [REAL, WIDE, BENT])
def test_forward_equals_forty_digits_over_the_whole_field(lens):
    theta = np.linspace(1e-9, lens.theta_max * (1 - 1e-9), 60)
    points = rays(theta, np.linspace(0, 20, 60)) * np.linspace(0.1, 9, 60)[:, None]
    exact = np.array([exact_kb_pixel(lens, p) for p in points])
    np.testing.assert_allclose(lens.project(points), exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", [REAL, WIDE, BENT])
@pytest.mark.parametrize("copies", [1, 60], ids=["few", "table"])
def test_inverse_equals_forty_digits(lens, copies):
    theta = np.linspace(1e-6, lens.theta_max - np.deg2rad(1.0), 40)
    pixels = lens.project(rays(theta, np.linspace(0, 20, 40)))
    exact = np.array([exact_kb_ray(lens, p) for p in pixels])
    found = lens.unproject(np.tile(pixels, (copies, 1)))[-40:]
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-13)


@pytest.mark.parametrize("lens", EXAMPLES)
def test_round_trip_over_the_image(lens):
    u, v = np.meshgrid(np.linspace(0, 1919, 97), np.linspace(0, 1079, 61))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    ray = lens.unproject(pixels)
    seen = np.isfinite(ray[:, 0])
    assert seen.sum() > 1000
    np.testing.assert_allclose(np.linalg.norm(ray[seen], axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(lens.project(ray * 1.7)[seen], pixels[seen], rtol=0, atol=1e-9)
    assert np.isnan(ray[~seen]).all()


@pytest.mark.parametrize("lens", EXAMPLES)
def test_round_trip_of_rays(lens):
    theta = np.linspace(0, lens.theta_max - np.deg2rad(1.0), 3000)
    ray = rays(theta, np.arange(3000.0))
    pixels = lens.project(ray)
    seen = np.isfinite(pixels[:, 0])
    np.testing.assert_allclose(lens.unproject(pixels)[seen], ray[seen], rtol=0, atol=1e-9)


def test_at_the_fold_the_inverse_is_as_good_as_a_double_root_allows():
    theta = REAL.theta_max - np.geomspace(1e-9, 1e-2, 50)
    found = REAL.unproject(REAL.project(rays(theta, np.zeros(50))))
    angle = np.arctan2(np.hypot(found[:, 0], found[:, 1]), found[:, 2])
    np.testing.assert_allclose(angle, theta, rtol=0, atol=3e-8)


def test_the_real_lens_of_the_thesis():
    assert np.rad2deg(REAL.theta_max) == pytest.approx(110.1507, abs=1e-4)
    corners = REAL.unproject([[0, 0], [1919, 0], [0, 1079], [1919, 1079]])
    angles = np.rad2deg(np.arctan2(np.hypot(corners[:, 0], corners[:, 1]), corners[:, 2]))
    np.testing.assert_allclose(angles, [85.21, 72.01, 84.10, 70.91], atol=0.01)


def test_equals_opencv_below_90_degrees():
    import cv2

    theta = np.concatenate([np.linspace(0, np.deg2rad(89.9), 500), [1e-12, 1e-7]])
    points = rays(theta, np.arange(502.0))
    K = np.array([[REAL.fx, 0, REAL.cx], [0, REAL.fy, REAL.cy], [0, 0, 1]])
    D = np.array([REAL.k1, REAL.k2, REAL.k3, REAL.k4])
    theirs = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    np.testing.assert_allclose(REAL.project(points), theirs, rtol=0, atol=1e-9)


def test_brown_conrady_equals_opencv():
    import cv2

    lens = BrownConrady(800.0, 790.0, 950.0, 530.0, -0.25, 0.08, -0.02)
    points = rays(np.linspace(0, 0.99 * lens.theta_max, 300), np.arange(300.0))
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    D = np.array([lens.k1, lens.k2, 0, 0, lens.k3])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    np.testing.assert_allclose(lens.project(points), theirs, rtol=0, atol=1e-9)


def test_equidistant_is_exact():
    lens = KannalaBrandt(300.0, 300.0, 500.0, 500.0)
    assert lens.theta_max == np.pi
    theta = np.linspace(0, np.deg2rad(179), 50)
    np.testing.assert_allclose(lens.project(rays(theta, np.zeros(50)))[:, 0], 500 + 300 * theta, atol=1e-11)


@pytest.mark.parametrize("degrees", [190, 220])
def test_lenses_that_look_behind_themselves(degrees):
    half = np.deg2rad(degrees / 2)
    lens = KannalaBrandt(500 / half, 500 / half, 500.0, 500.0)
    edge = lens.unproject([[1000.0, 500.0], [500.0, 0.0]])
    np.testing.assert_allclose(np.arctan2(np.hypot(edge[:, 0], edge[:, 1]), edge[:, 2]), half, atol=1e-14)
    assert (edge[:, 2] < 0).all()


def test_axis_zero_and_behind():
    pixels = REAL.project([[0, 0, 1], [1e-14, 0, 1], [1e-300, 0, 1], [0, 0, 0], [0, 0, -1], [0.1, 0, -1]])
    np.testing.assert_allclose(pixels[:3], [[REAL.cx, REAL.cy]] * 3, atol=1e-9)
    assert np.isnan(pixels[3:]).all()
    np.testing.assert_array_equal(REAL.unproject([[REAL.cx, REAL.cy]]), [[0, 0, 1]])
    for lens in (VIRTUAL, LISTING):
        assert np.isnan(lens.project([[0, 0, 0], [0.1, 0, 0], [0, 0, -1], [0.1, 0.1, -1]])).all()


def test_what_the_lens_does_not_image_is_nan():
    radius = REAL.project(rays(np.array([REAL.theta_max]), np.zeros(1)))[0, 0] - REAL.cx
    ray = REAL.unproject([[REAL.cx + radius * (1 - 1e-12), REAL.cy], [REAL.cx + radius + 1e-6, REAL.cy]])
    assert np.isfinite(ray[0]).all()
    assert np.isnan(ray[1]).all()
    assert np.isnan(REAL.project(rays(np.array([REAL.theta_max + 1e-9]), np.zeros(1)))).all()
    assert np.isnan(REAL.unproject([[np.nan, 3.0]])).all()
    assert np.isnan(REAL.project([[np.nan, 0.0, 1.0]])).all()


def test_brown_conrady_ends_at_its_fold():
    assert np.tan(VIRTUAL.theta_max) == pytest.approx(np.sqrt(1 / 0.6), abs=1e-12)
    inside, outside = VIRTUAL.unproject([[960 + 513.3, 540], [960 + 513.4, 540]])
    assert np.isfinite(inside).all()
    assert np.isnan(outside).all()
    pinhole = BrownConrady(500.0, 500.0, 0.0, 0.0)
    assert pinhole.theta_max == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(pinhole.project([[3.0, 4.0, 2.0]]), [[750.0, 1000.0]], atol=1e-12)
    far = np.array([[1e7, 0.0], [0.0, 1e3]])
    np.testing.assert_allclose(pinhole.project(pinhole.unproject(far)), far, rtol=1e-12)


def test_division_model_paints_a_third_of_its_image_black():
    u, v = np.meshgrid(np.arange(0, 1920, 4), np.arange(0, 1080, 4))
    black = np.isnan(LISTING.unproject(np.stack([u.ravel(), v.ravel()], -1))[:, 0]).mean()
    assert black == pytest.approx(0.323, abs=2e-3)
    # The listing itself, for one pixel: half way to the right edge.
    x = 0.5 / (1 - 0.2 * 0.25)
    np.testing.assert_allclose(
        LISTING.unproject([[1440.0, 540.0]])[0, 0] / LISTING.unproject([[1440.0, 540.0]])[0, 2], x * 960 / 596.43
    )


@pytest.mark.parametrize("lens", EXAMPLES)
def test_jacobian_equals_central_differences(lens):
    theta = np.concatenate([[1e-9, 1e-4], np.linspace(0.05, 0.8 * lens.theta_max, 12)])
    points = rays(theta, np.linspace(0.3, 9, 14)) * 1.3
    seen = np.isfinite(lens.project(points)[:, 0])
    points = points[seen]
    pixels, d_point, d_parameters = lens.project_jacobian(points)
    np.testing.assert_allclose(pixels, lens.project(points), rtol=0, atol=1e-10)
    step = 1e-6
    for axis in range(3):
        delta = step * np.eye(3)[axis]
        numeric = (lens.project(points + delta) - lens.project(points - delta)) / (2 * step)
        np.testing.assert_allclose(d_point[:, :, axis], numeric, rtol=1e-6, atol=1e-5)
    for index, name in enumerate(lens.names()):
        value = getattr(lens, name)
        h = 1e-6 * max(1.0, abs(value))
        above, below = replace(lens, **{name: value + h}), replace(lens, **{name: value - h})
        numeric = (above.project(points) - below.project(points)) / (2 * h)
        np.testing.assert_allclose(d_parameters[:, :, index], numeric, rtol=1e-6, atol=1e-5)


def test_jacobian_on_the_axis_and_outside():
    for lens in EXAMPLES:
        pixels, d_point, d_parameters = lens.project_jacobian([[0.0, 0.0, 2.0], [0.0, 0.0, -1.0]])
        np.testing.assert_allclose(pixels[0], [lens.cx, lens.cy])
        on_axis = 1 / (1 + lens.xi) if isinstance(lens, DoubleSphere) else 1.0
        expected = np.array([[lens.fx / 2, 0, 0], [0, lens.fy / 2, 0]]) * on_axis
        np.testing.assert_allclose(d_point[0], expected, atol=1e-9)
        assert np.isfinite(d_parameters[0]).all()
        assert np.isnan(d_point[1]).all()


coefficient = st.floats(-0.3, 0.3)


@settings(max_examples=60, deadline=None)
@given(k1=coefficient, k2=coefficient, k3=coefficient, k4=coefficient)
def test_any_coefficients_give_an_exact_inverse_up_to_their_fold(k1, k2, k3, k4):
    for lens in (
        KannalaBrandt(500.0, 510.0, 100.0, 50.0, k1, k2, k3, k4),
        BrownConrady(500.0, 510.0, 100.0, 50.0, k1, k2, k3, k4),
    ):
        theta = np.linspace(0, 0.98 * min(lens.theta_max, 3.0), 1500)
        pixels = lens.project(rays(theta, np.arange(1500.0)))
        assert np.isfinite(pixels).all()
        again = lens.project(lens.unproject(pixels))
        np.testing.assert_allclose(again, pixels, rtol=1e-13, atol=1e-9)
        few = lens.unproject(pixels[:50])
        np.testing.assert_allclose(few, lens.unproject(pixels)[:50], rtol=0, atol=1e-12)


tangential = st.floats(-0.02, 0.02)
term = st.floats(-0.5, 0.5)


@settings(max_examples=60, deadline=None)
@given(
    k=st.tuples(*[coefficient] * 4),
    p1=tangential,
    p2=tangential,
    prism=st.tuples(tangential, tangential),
    over=st.tuples(*[term] * 3),
    under=st.tuples(*[term] * 3),
)
def test_any_tangential_terms_give_an_exact_inverse_within_the_field(k, p1, p2, prism, over, under):
    for lens in (
        TangentialKannalaBrandt(500.0, 510.0, 100.0, 50.0, *k, p1, p2),
        TangentialKannalaBrandt(500.0, 510.0, 100.0, 50.0, *k, p1, p2, *prism),
        TangentialBrownConrady(500.0, 510.0, 100.0, 50.0, *k, p1, p2),
        Rational(500.0, 510.0, 100.0, 50.0, *over, *under, p1, p2),
    ):
        theta = np.linspace(0, 0.98 * lens.theta_max, 1500)
        ray = rays(theta, np.arange(1500.0))
        pixels = lens.project(ray)
        assert np.isfinite(pixels).all()
        found = lens.unproject(pixels)
        scale = 1 + np.abs(pixels).max(1, keepdims=True)
        assert (np.abs(lens.project(found) - pixels) <= 1e-12 * scale + 1e-9).all()
        beyond = np.array([lens.theta_max + 1e-6])
        assert beyond > np.pi or np.isnan(lens.project(rays(beyond, np.zeros(1)))).all()


@settings(max_examples=60, deadline=None)
@given(alpha=st.floats(0, 1), beta=st.floats(0.1, 5), xi=st.floats(-0.9, 1))
def test_any_sphere_gives_an_exact_inverse_within_the_field(alpha, beta, xi):
    for lens in (
        Unified(500.0, 510.0, 100.0, 50.0, alpha),
        ExtendedUnified(500.0, 510.0, 100.0, 50.0, alpha, beta),
        DoubleSphere(500.0, 510.0, 100.0, 50.0, xi, alpha),
    ):
        theta = np.linspace(0, min(0.98 * lens.theta_max, 3.1), 400)
        pixels = lens.project(rays(theta, np.arange(400.0)))
        radius = np.hypot((pixels[:, 0] - lens.cx) / lens.fx, (pixels[:, 1] - lens.cy) / lens.fy)
        assert (np.diff(radius) > 0).all()
        again = lens.project(lens.unproject(pixels))
        scale = 1 + np.abs(pixels).max(1, keepdims=True)
        assert (np.abs(again - pixels) <= 1e-11 * scale).all()
        beyond = np.array([lens.theta_max + 1e-6])
        assert beyond > np.pi or np.isnan(lens.project(rays(beyond, np.zeros(1)))).all()


@pytest.mark.parametrize("lens", TURNED)
def test_a_tangential_lens_is_one_to_one_up_to_its_edge_and_not_beyond(lens):
    turn = np.linspace(0, 2 * np.pi, 721)
    theta = min(lens.theta_max, np.deg2rad(89)) * (1 - 1e-9)
    _, by_point, _ = lens.project_jacobian(rays(np.full(721, theta), turn))
    across = np.stack([np.cos(theta) * np.cos(turn), np.cos(theta) * np.sin(turn), np.full(721, -np.sin(theta))], -1)
    around = np.stack([-np.sin(turn), np.cos(turn), np.zeros(721)], -1)
    slopes = np.stack([np.einsum("nij,nj->ni", by_point, way) for way in (across, around)], -1)
    least = np.linalg.det(slopes).min() / (lens.fx * lens.fy)
    assert least > -1e-9
    if lens.theta_max < np.deg2rad(89):
        assert least < 0.01


def test_the_rational_model_equals_opencv():
    import cv2

    points = rays(np.linspace(0, 0.9 * OPENCV8.theta_max, 300), np.arange(300.0))
    K = np.array([[OPENCV8.fx, 0, OPENCV8.cx], [0, OPENCV8.fy, OPENCV8.cy], [0, 0, 1]])
    k1, k2, k3, k4, k5, k6, p1, p2 = OPENCV8.parameters[4:]
    D = np.array([k1, k2, p1, p2, k3, k4, k5, k6])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    np.testing.assert_allclose(OPENCV8.project(points), theirs, rtol=1e-12, atol=1e-9)


def test_tangential_terms_equal_opencv_and_colmap():
    import cv2

    lens = TangentialBrownConrady(800.0, 790.0, 950.0, 530.0, -0.1, 0.02, -0.001, 0.0, 1e-3, -2e-3)
    points = rays(np.linspace(0, 0.8 * lens.theta_max, 300), np.arange(300.0))
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    D = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    np.testing.assert_allclose(lens.project(points), theirs, rtol=1e-12, atol=1e-9)
    # THIN_PRISM_FISHEYE: the same terms, of theta times the direction across the axis.
    for lens in (SKEWED, PRISM):
        x, y, z = rays(np.array([1.3]), np.array([0.7]))[0]
        u, v = np.array([x, y]) / np.hypot(x, y) * 1.3
        square = u * u + v * v
        radial = sum(k * square ** (n + 1) for n, k in enumerate(lens.radial_terms))
        du = u * radial + 2 * lens.p1 * u * v + lens.p2 * (square + 2 * u * u) + lens.sx1 * square
        dv = v * radial + 2 * lens.p2 * u * v + lens.p1 * (square + 2 * v * v) + lens.sy1 * square
        expected = [lens.fx * (u + du) + lens.cx, lens.fy * (v + dv) + lens.cy]
        np.testing.assert_allclose(lens.project([x, y, z]), expected, rtol=0, atol=1e-9)


def test_the_unified_model_equals_opencvs_omnidir():
    import cv2

    points = rays(np.linspace(0, 1.5, 300), np.arange(300.0))
    for lens in (ROUND, FLAT):
        xi = lens.alpha / (1 - lens.alpha)
        fx, fy = lens.fx * (1 + xi), lens.fy * (1 + xi)
        K = np.array([[fx, 0, lens.cx], [0, fy, lens.cy], [0, 0, 1]])
        zero = np.zeros((1, 3))
        theirs = cv2.omnidir.projectPoints(points[None], zero, zero, K, xi, np.zeros((1, 4)))[0]
        np.testing.assert_allclose(lens.project(points), theirs.reshape(-1, 2), rtol=1e-12, atol=1e-9)


def test_models_that_contain_others_equal_them():
    points = np.random.default_rng(2).normal([0, 0, 0.5], 1.0, (200, 3))
    pairs = [
        (DoubleSphere(700.0, 702.0, 955.0, 545.0, 0.0, 0.5), STEREOGRAPHIC),
        (ExtendedUnified(700.0, 702.0, 955.0, 545.0, 0.2, 1.0), FLAT),
        (replace(SKEWED, p1=0.0, p2=0.0), KannalaBrandt(500.0, 510.0, 960.0, 540.0, -0.02)),
        (Rational(596.43, 596.43, 960.0, 540.0, -0.2), VIRTUAL),
    ]
    for wide, narrow in pairs:
        assert wide.theta_max == pytest.approx(narrow.theta_max, abs=1e-7)
        np.testing.assert_allclose(wide.project(points), narrow.project(points), rtol=1e-13, atol=1e-10)


@pytest.mark.parametrize("lens", EXAMPLES)
def test_a_lens_comes_back_from_its_keys(lens):
    if isinstance(lens, Equisolid):
        return
    from avcli.formats import experiment

    written = lens_config(lens)
    assert written["lens_model"] == name_of(lens)
    assert experiment.lens_from_config(json.loads(json.dumps(written))) == lens


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"lens_model": "eucm", "alpha": 0.5}, '"camera_config.beta" is missing; the lens model eucm needs it'),
        ({"lens_model": "ucm", "alpha": 1.5}, '"camera_config.alpha" must be a number from 0 to 1'),
        ({"lens_model": "ucm", "alpha": 0.5, "k1": 0.1}, '"camera_config.k1" is no coefficient of the lens model ucm'),
        ({"lens_model": "division", "p1": 0.1}, '"camera_config.p1" is no coefficient of the lens model division'),
    ],
)
def test_a_coefficient_that_is_missing_or_foreign_is_refused(values, message):
    from avcli.formats import experiment

    with pytest.raises(experiment.ConfigError) as error:
        experiment.lens_from_config({"fx_px": 500, "fy_px": 500, "cx_px": 500, "cy_px": 500, **values})
    assert message in str(error.value)


def test_every_registered_lens_has_an_example():
    assert set(variants().values()) <= {type(lens) for lens in EXAMPLES}


@pytest.mark.parametrize(
    "values",
    [
        {"lens_model": "kannala_brandt", "k1": -0.02, "p1": 0.01, "p2": -0.01},
        {"lens_model": "rational", "k1": 0.1, "k4": 0.3, "p1": 0.01},
        {"lens_model": "double_sphere", "xi": -0.2, "alpha": 0.59},
    ],
    ids=lambda values: values["lens_model"],
)
def test_a_scene_is_drawn_through_the_lens(values):
    from avcli.scene.film import simulate

    camera = {
        "fx_px": 60.0, "fy_px": 60.0, "cx_px": 79.5, "cy_px": 59.5, "image_width_px": 160, "image_height_px": 120,
        "camera_position_m": [2.33, 2.33, 2.5], **values,
    }  # fmt: skip
    scene = simulate({"camera_config": camera, "duration_s": 0.0})
    next(scene.shots())
    at = np.array([[79.0, 59.0], [50.0, 59.0], [110.0, 50.0], [79.0, 30.0], [70.0, 85.0]])
    rays = scene.config.camera.lens.unproject(at)
    down = scene.background[at[:, 1].astype(int), at[:, 0].astype(int)] * 1e-4 * rays[:, 2]
    np.testing.assert_allclose(down, 2.5, atol=2e-4)


def test_a_lens_is_registered_in_one_place():
    """One entry of LENSES: the program then reads it from a config, lists it in errors, and draws through it."""
    camera = {
        "lens_model": "equisolid", "fx_px": 60.0, "fy_px": 60.0, "cx_px": 79.5, "cy_px": 59.5, "k1": -0.02,
        "image_width_px": 160, "image_height_px": 120, "camera_position_m": [2.33, 2.33, 2.5],
    }  # fmt: skip
    program = f"""
import json, sys
import numpy as np
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_lens import Equisolid
from avcli.lens import LENSES, name_of
LENSES["equisolid"] = Equisolid
from avcli.formats import experiment
from avcli.scene.film import simulate
scene = simulate({{"camera_config": json.loads({json.dumps(json.dumps(camera))}), "duration_s": 0.0}})
lens = scene.config.camera.lens
assert lens == Equisolid(60.0, 60.0, 79.5, 59.5, -0.02) and name_of(lens) == "equisolid"
shot = next(scene.shots())
rays = lens.unproject([[79.0, 59.0], [79.0, 30.0]])
down = scene.background[[59, 30], 79] * 1e-4 * rays[:, 2]
assert np.abs(down - 2.5).max() < 2e-4, down
try:
    experiment.lens_from_config({{"lens_model": "fisheye"}})
except experiment.ConfigError as error:
    print(error)
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "equisolid" in result.stdout


def test_an_equisolid_lens_gives_equal_areas_to_equal_solid_angles():
    radius = EQUAL_AREA.project(rays(np.linspace(0, np.pi, 20), np.zeros(20)))[:, 0] - 960.0
    solid_angle = 2 * np.pi * (1 - np.cos(np.linspace(0, np.pi, 20)))
    np.testing.assert_allclose(np.pi * (radius / 600.0) ** 2, solid_angle, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("lens", EXAMPLES)
def test_the_shaders_rays_are_the_lens(lens):
    values = shader.uniforms(lens, 1920, 1080)
    u, v = np.meshgrid(np.linspace(0, 1919, 61), np.linspace(0, 1079, 41))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    inverse_square, ends, limit, bounded = values["domain"]

    def at(m):
        square = np.sum(m * m, -1)
        w = np.sqrt(np.maximum(1 - square * inverse_square, 0)) if ends else square * inverse_square
        series = np.array(values["series"]).reshape(values["segments"], -1, 2)
        first = np.clip((w * len(series)).astype(int), 0, len(series) - 1)
        place = 2 * (w * len(series) - first) - 1
        across, ahead = np.einsum(
            "nt,ntk->kn", np.polynomial.chebyshev.chebvander(place, series.shape[1] - 1), series[first]
        )
        lateral = m * across[:, None]
        ray = np.concatenate([lateral * values["stretch"], ahead[:, None]], 1)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        return ray, (square <= limit) & ~(bool(bounded) & (np.abs(lateral).max(1) > 1))

    plane = m = (pixels - values["centre"]) * values["per_px"]
    ray, seen = at(m)
    if "tangent" in values:
        p, a, bends_angles = np.array(values["tangent"][:2]), np.array(values["tangent"][2:]), values["angular"]
        for _ in range(int(shader.specialised("TURNS", values))):
            lateral = np.hypot(ray[:, 0], ray[:, 1])
            s = np.arctan2(lateral, ray[:, 2]) if bends_angles else lateral / ray[:, 2]
            q = m * (s / np.linalg.norm(m, axis=1))[:, None]
            m = plane - np.sum(q * q, -1)[:, None] * a - 2 * (q @ p)[:, None] * q
            ray, seen = at(m)
    exact = lens.unproject(pixels)
    imaged = np.isfinite(exact[:, 0])
    if "tangent" in values and not imaged.all():  # at the very rim of the field the fixed point is slow
        assert (seen != imaged).mean() < 0.01
        off = np.linalg.norm(lens.project(ray[seen & imaged]) - pixels[seen & imaged], axis=1)
        assert np.nanquantile(off, 0.99) < 0.01
    else:
        assert (seen == imaged).all()
        np.testing.assert_allclose(ray[seen], exact[seen], rtol=0, atol=2e-7)


@pytest.mark.parametrize("lens", EXAMPLES)
def test_a_clamped_projection_is_finite_and_keeps_what_is_seen(lens):
    points = np.random.default_rng(1).normal(size=(500, 3))
    pixels, clamped = lens.project(points), lens.project_clamped(points)
    assert np.isfinite(clamped).all()
    seen = np.isfinite(pixels[:, 0])
    np.testing.assert_allclose(clamped[seen], pixels[seen], rtol=1e-7, atol=1e-4)


@pytest.mark.parametrize("module", [avcli.lens, pose])
def test_the_samples_in_the_docstrings_run(module):
    tried = doctest.testmod(module)
    assert tried.attempted
    assert not tried.failed


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        REAL.project(np.zeros((4, 2)))
    assert REAL.project(np.zeros((0, 3))).shape == (0, 2)
    assert REAL.unproject(np.zeros((0, 2))).shape == (0, 3)


def test_a_full_frame_costs_less_than_a_few_of_opencvs():
    import cv2

    u, v = np.meshgrid(np.arange(960.0), np.arange(540.0))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    K = np.array([[REAL.fx, 0, REAL.cx], [0, REAL.fy, REAL.cy], [0, 0, 1]])
    D = np.array([REAL.k1, REAL.k2, REAL.k3, REAL.k4])
    REAL.unproject(pixels)

    def cost(work):
        times = []
        for _ in range(3):
            start = time.process_time()
            work()
            times.append(time.process_time() - start)
        return min(times)

    assert cost(lambda: REAL.unproject(pixels)) < 4 * cost(lambda: cv2.fisheye.undistortPoints(pixels[:, None], K, D))
