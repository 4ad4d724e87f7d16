"""Octave bands: materials, air and the head of a talker."""

import doctest
from dataclasses import replace

import numpy as np
import pytest

from avcli.acoustics import bands, hear
from avcli.acoustics.bands import BANDS_HZ, BEHIND_DB, Bands, curves, spectra_of_bands
from avcli.acoustics.decay import image_rt60
from avcli.acoustics.images import arrivals
from avcli.acoustics.responses import TAPS, Responses, impulse_responses, lowpass
from avcli.acoustics.settings import Settings
from avcli.acoustics.surroundings import Surroundings, surroundings_of
from avcli.formats.experiment import Config
from avcli.formats.records import Identified
from avcli.materials import decay
from avcli.materials.decay import (
    air_absorption,
    contents_loss,
    energy_decay,
    reverberation_time,
    scattered_energy,
    unmirrored,
)

ROOM = np.array([4.66, 4.66, 3.0])
MICROPHONES = np.array([[0.6, 4.0, 2.4], [4.0, 1.0, 2.0]])
RATE, LENGTH = 16000, 1 << 15
PLACE = np.array([1.73, 2.33, 1.6])
AHEAD = np.array([1.0, 0.0, 0.0])
MATERIALS = {"floor": "carpet", "walls": "wood_panel", "ceiling": "acoustic_tile"}


def config(**keys):
    room = {"room_dimensions_m": ROOM.tolist(), "surfaces": MATERIALS, **keys}
    microphones = {"mic_positions_m": MICROPHONES.tolist(), "audio_sample_rate_hz": RATE}
    return Config({"room_config": room, "microphone_config": microphones})


def response(surroundings, place=PLACE, heading=AHEAD, rng=None):
    found = Responses(surroundings, LENGTH, lowpass(0.5, -60.0), -60.0, rng)
    return np.fft.irfft(found.at([(place, heading, surroundings.microphones_m[None])])[0], LENGTH)


def in_octave(sound, middle_hz):
    padded = np.append(sound, np.zeros(len(sound)))
    octaves = np.log2(np.maximum(np.fft.rfftfreq(len(padded), 1 / RATE), 1.0) / middle_hz)
    smooth = np.where(np.abs(octaves) < 0.5, 0.5 + 0.5 * np.cos(2 * np.pi * octaves), 0.0)  # a sharp edge would ring
    return np.fft.irfft(np.fft.rfft(padded) * smooth)[: len(sound)]


def test_air_absorbs_as_the_standard_says():
    assert doctest.testmod(decay).failed == 0
    assert (np.diff(air_absorption(BANDS_HZ)) > 0).all()
    assert np.isfinite(air_absorption(BANDS_HZ, -20.0, 0.0)).all()


def test_bands_are_joined_to_one_spectrum_of_short_responses():
    np.testing.assert_allclose(curves([1, 50, 125, 180, 1000, 5000, 20000]).sum(axis=0), 1.0)
    np.testing.assert_allclose(curves(BANDS_HZ), np.eye(8), atol=1e-12)
    spectra = spectra_of_bands(LENGTH, LENGTH // 2 + 1, RATE)
    np.testing.assert_allclose(spectra.sum(axis=0), 1.0, atol=1e-12)
    impulses = np.fft.irfft(spectra, LENGTH)
    reach = int(np.ceil(bands.REACH_S * RATE))
    assert np.abs(impulses[:, reach + 1 : -reach - 1]).max() < 1e-12


def test_bands_that_are_all_alike_sound_as_without_bands():
    plain = Surroundings(ROOM, np.full(6, -0.8), MICROPHONES, RATE, 40.0)
    alike = replace(plain, bands=Bands(np.full((6, 8), 0.36), np.zeros(8), np.zeros(8), np.full(8, 0.3)))
    expected, found = response(plain), response(alike)
    later = alike.spread - plain.spread
    error = found[:, later:] - expected[:, : LENGTH - later]
    assert 10 * np.log10(np.sum(error**2) / np.sum(expected**2)) < -100


@pytest.mark.parametrize("ism_decay_db", [10.0, 20.0])
def test_each_band_decays_in_its_time(ism_decay_db):
    rng, times = np.random.default_rng(2), []
    settings = Settings(error_db=-45.0, ism_decay_db=ism_decay_db)
    around = surroundings_of(config(), settings)
    for seed in range(3):
        microphones, place = rng.uniform(0.5, ROOM - 0.5, (2, 3)), rng.uniform(0.5, ROOM - 0.5)
        here = replace(around, microphones_m=microphones, directivities=None, orientations=None)
        for sound in response(here, place, rng=np.random.default_rng(seed))[
            :, TAPS + around.spread : TAPS + around.spread + around.longest_delay
        ]:
            for middle in BANDS_HZ[2:6]:
                energy = np.cumsum(in_octave(sound, middle)[::-1] ** 2)[::-1]
                level = 10 * np.log10(energy / energy[0])
                inside = (level < -5) & (level > -35)
                times.append(-60 / np.polyfit(np.flatnonzero(inside) / RATE, level[inside], 1)[0])
    found = np.reshape(times, (-1, 4)).mean(axis=0)
    np.testing.assert_allclose(found, around.bands.rt60_s[2:6], rtol=0.12)


def test_air_makes_the_high_bands_shorter():
    air = air_absorption(16000.0) * np.log(10) / 20
    without, found = image_rt60((10, 8, 3.5), 0.1), image_rt60((10, 8, 3.5), 0.1, air=float(air))
    assert 1 / found == pytest.approx(1 / without + 2 * float(air) * 343 / (6 * np.log(10)), rel=0.1)


def test_a_voice_is_fainter_behind_the_head_the_more_the_higher():
    head = Bands(np.ones((6, 8)), np.zeros(8), np.array(BEHIND_DB), np.zeros(8))
    around = Surroundings(ROOM, np.zeros(6), np.array([[4.0, 2.33, 1.6]]), RATE, 8.0, bands=head)
    ahead, behind = response(around)[0], response(around, heading=-AHEAD)[0]
    for middle, expected in zip(BANDS_HZ[1:6], BEHIND_DB[1:6], strict=True):
        levels = [np.sum(in_octave(sound, middle) ** 2) for sound in (ahead, behind)]
        assert 10 * np.log10(levels[0] / levels[1]) == pytest.approx(expected, abs=1.0)


def test_materials_are_heard_where_no_reverberation_time_is_set():
    walk = [Identified(t, np.array([0]), np.array([[1.0 + t, 2.0, 0.0]])) for t in np.arange(3) / 10]
    settings = Settings(error_db=-20.0, ism_decay_db=5.0, source_directivity="voice")
    heard, again = (hear(config(), walk, settings=settings).samples for _ in range(2))
    assert np.isfinite(heard).all()
    assert np.array_equal(heard, again)
    damp = hear(config(), walk, settings=replace(settings, humidity_percent=10.0)).samples
    assert not np.array_equal(heard, damp)
    set_time = Settings(error_db=-20.0, rt60_s=0.15)
    plain = Config(
        {"room_config": {"room_dimensions_m": ROOM.tolist()}, "microphone_config": config().raw["microphone_config"]}
    )
    assert np.array_equal(hear(config(), walk, settings=set_time).samples, hear(plain, walk, settings=set_time).samples)


def test_hard_materials_are_followed_as_far_as_is_affordable():
    said = []
    around = surroundings_of(
        config(surfaces={"floor": "marble", "walls": "marble", "ceiling": "marble"}), Settings(), say=said.append
    )
    assert any("then noise" in sentence for sentence in around.described())
    assert said == []
    assert around.end_s == pytest.approx(around.bands.rt60_s.max())


def test_the_mean_decay_is_that_of_the_images():
    room, absorption, loss = np.array([8.0, 6.0, 3.0]), np.array([0.03, 0.9, 0.04, 0.03, 0.06, 0.75]), 0.0035
    rng, edges = np.random.default_rng(0), np.arange(0.0, 200, 24)  # echoes come in clusters
    heard = np.zeros(len(edges) - 1)
    for _ in range(20):
        places = rng.uniform(0.0, room, (2, 3))
        distances, gains = arrivals(room, places[0], np.sqrt(1 - absorption), places[1], edges[-1])
        energies = (gains / distances) ** 2 * np.exp(-2 * loss * distances)
        heard += np.histogram(distances, edges, weights=energies)[0] / 20
    ways = np.arange(0.5, edges[-1])
    decays = energy_decay(room, absorption, loss, 343.0, ways / 343.0).reshape(-1, 24).sum(axis=1)
    np.testing.assert_allclose(10 * np.log10(heard / (4 * np.pi / room.prod() * decays))[1:], 0.0, atol=0.7)


def test_contents_shorten_the_reverberation_as_sabine_has_it():
    cube, hard = np.array([5.0, 5.0, 5.0]), np.full(6, 0.02)
    assert reverberation_time(cube, hard, 0.0, 343.0) == pytest.approx(0.161 * 125 / (150 * 0.02), rel=0.08)
    found = reverberation_time(cube, hard, float(contents_loss(cube, 30.0)), 343.0)
    assert found == pytest.approx(0.161 * 125 / (150 * 0.02 + 30.0), rel=0.02)


def test_what_stands_in_the_room_absorbs_too():
    stated = config(contents_absorption_m2=[4, 4, 5, 6, 7, 7, 7], reverberation_time_s=9.0)
    said = []
    bare, full = (surroundings_of(c, Settings(), say=said.append) for c in (config(), stated))
    assert '"room_config.reverberation_time_s" is 9, but the materials and contents' in said[0]
    np.testing.assert_allclose(full.bands.air - bare.bands.air, np.array([4, 4, 5, 6, 7, 7, 7, 7]) / 8 / ROOM.prod())
    assert (full.bands.rt60_s < bare.bands.rt60_s).all()
    number = surroundings_of(config(reverberation_time_s=0.3), Settings())
    assert number.bands is None
    assert number.rt60_s == 0.3


def traced(room, absorption, scattering, times, rays=6000):
    """Energy of rays in a box that are mirrored, or scattered by Lambert's law, by chance at each wall."""
    rng, index = np.random.default_rng(0), np.arange(rays)
    place, way = rng.uniform(0, 1, (rays, 3)) * room, rng.normal(size=(rays, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    clock, energy, steps = np.zeros(rays), np.ones(rays), np.zeros(len(times) + 1)
    while clock.min() < times[-1]:
        ahead = np.where(way > 0, room - place, place) / np.maximum(np.abs(way), 1e-12)
        axis = ahead.argmin(axis=1)
        then = clock + ahead[index, axis] / 343
        np.add.at(steps, np.searchsorted(times, clock), energy)
        np.add.at(steps, np.searchsorted(times, then), -energy)
        place, clock, high = place + ahead[index, axis, None] * way, then, way[index, axis] > 0
        energy = energy * (1 - absorption[2 * axis + high])
        way[index, axis] *= -1
        anew = rng.random(rays) < scattering[2 * axis + high]
        up, turn = np.sqrt(rng.random(rays)), rng.uniform(0, 2 * np.pi, rays)
        lambert = np.empty((rays, 3))
        lambert[index, axis] = np.where(high, -up, up)
        lambert[index, (axis + 1) % 3] = np.sqrt(1 - up**2) * np.cos(turn)
        lambert[index, (axis + 2) % 3] = np.sqrt(1 - up**2) * np.sin(turn)
        way = np.where(anew[:, None], lambert, way)
        place[index, axis] = np.where(high, room[axis], 0.0)
    return np.cumsum(steps)[:-1] / rays


@pytest.mark.parametrize(
    ("room", "absorption", "scattering"),
    [
        ([8.0, 6.0, 3.0], [0.03, 0.03, 0.03, 0.03, 0.1, 0.8], [0.05] * 6),
        ([18.0, 3.0, 2.8], [0.03, 0.02, 0.02, 0.03, 0.03, 0.75], [0.1, 0.1, 0.1, 0.1, 0.06, 0.12]),
        ([5.0, 4.5, 2.8], [0.05, 0.05, 0.05, 0.05, 0.05, 0.75], [0.04, 0.04, 0.04, 0.04, 0.06, 0.12]),
    ],
)
def test_scattered_sound_decays_as_that_of_traced_rays(room, absorption, scattering):
    room, absorption, scattering = np.array(room), np.array(absorption), np.array(scattering)
    times = np.linspace(0, 0.6, 120)
    box = 0.0, 343.0, times
    found = energy_decay(room, unmirrored(absorption, scattering), *box)
    found += scattered_energy(room, absorption, scattering, *box)
    expected = traced(room, absorption, scattering, times)
    loud = expected > 3e-3  # of fainter sound there are few rays
    assert np.abs(10 * np.log10(found[loud] / expected[loud])).max() < 1.2
    mirrors = energy_decay(room, absorption, *box)
    assert np.abs(10 * np.log10(mirrors[loud] / expected[loud])).max() > 2.5
    assert reverberation_time(room, absorption, 0.0, 343.0) > 1.6 * reverberation_time(
        room, absorption, 0.0, 343.0, scattering
    )


def test_scattering_takes_no_energy_and_little_of_it_changes_little():
    times = np.linspace(0, 0.3, 50)
    hardly = np.full(6, 0.005)
    for scattering in (0.05, 0.5, 1.0):
        scatters = np.full(6, scattering)
        found = energy_decay(ROOM, unmirrored(hardly, scatters), 0.0, 343.0, times)
        found += scattered_energy(ROOM, hardly, scatters, 0.0, 343.0, times)
        np.testing.assert_allclose(found, energy_decay(ROOM, hardly, 0.0, 343.0, times), rtol=0.02)
    walls = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.6])
    assert not scattered_energy(ROOM, walls, np.zeros(6), 0.0, 343.0, times).any()
    alike = [reverberation_time(ROOM, walls, 0.0, 343.0, np.full(6, share)) for share in (0.0, 1e-4)]
    assert alike[1] == pytest.approx(alike[0], rel=0.01)


def test_what_walls_scatter_is_heard_after_the_sound_itself():
    around = surroundings_of(config(room_dimensions_m=[8.0, 6.0, 3.0]), Settings())
    assert around.bands is not None
    assert around.bands.scattering is not None
    mirrors = replace(around, bands=replace(around.bands, scattering=None))
    found = [response(here, rng=np.random.default_rng(0)) for here in (around, mirrors)]
    direct = np.linalg.norm(MICROPHONES - PLACE, axis=1) * around.samples_per_m + TAPS + around.spread
    ringing = np.arange(LENGTH) < direct[:, None] - bands.reach_samples(RATE)
    for one in found:
        assert (one**2)[ringing].sum() < 1e-6 * (one**2).sum()
    times = []
    for one in found:
        level = 10 * np.log10(np.cumsum(in_octave(one[0], 1000)[::-1] ** 2)[::-1])
        fitted = np.flatnonzero((level < level[0] - 5) & (level > level[0] - 35))
        times.append(-60 / np.polyfit(fitted / RATE, level[fitted], 1)[0])
    assert times[0] == pytest.approx(around.bands.rt60_s[3], rel=0.15)
    assert times[0] < 0.85 * times[1]


def test_exported_responses_hold_what_is_scattered():
    around = surroundings_of(config(room_dimensions_m=[8.0, 6.0, 3.0]), Settings())
    found = impulse_responses(around, np.array([PLACE]))[0]
    heard = response(around, rng=np.random.default_rng(0))
    for one, other in zip(found, heard, strict=True):
        levels = [10 * np.log10(np.sum(in_octave(sound, 1000) ** 2)) for sound in (one, other)]
        assert levels[0] == pytest.approx(levels[1], abs=0.3)
    level = 10 * np.log10(np.cumsum(in_octave(found[0], 1000)[::-1] ** 2)[::-1])
    fitted = np.flatnonzero((level < level[0] - 5) & (level > level[0] - 35))
    time = -60 / np.polyfit(fitted / RATE, level[fitted], 1)[0]
    assert time == pytest.approx(around.bands.rt60_s[3], rel=0.15)
