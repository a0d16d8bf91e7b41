"""Pictures of the network: what is planted is where it belongs, in its colour, and fast enough."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from ugat_marl.effects import load_scenario
from ugat_marl.envs import NetworkRenderer, parallel_env
from ugat_marl.envs.rendering import _OFF, _RED, _SIGNALS, _SPEEDS
from ugat_marl.scenarios import Network
from ugat_marl.simulation import VehiclePositions


@pytest.fixture(scope="module")
def network(data: Path) -> Network:
    return Network.read(load_scenario(data / "crossing"))


def traffic(*rows: tuple[float, float, float, float, float]) -> VehiclePositions:
    """x, y, heading, length, speed."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return VehiclePositions(table[:, :2], table[:, 2], table[:, 3], table[:, 4])


def near(pixels: np.ndarray, colour: str, tolerance: int = 12) -> np.ndarray:
    """Where a picture has a colour: rows and columns, ``(n, 2)``."""
    rgb = np.round(np.array(to_rgb(colour)) * 255)
    return np.argwhere(np.abs(pixels.astype(int) - rgb).max(axis=2) <= tolerance)


def at(picture: NetworkRenderer, pixels: np.ndarray, x: float, y: float) -> tuple[int, int]:
    right, up = picture._view.pixels(np.array([x, y]))
    return int(pixels.shape[0] - up), int(right)


def test_vehicles_are_where_they_are_in_the_colour_of_their_speed(network: Network) -> None:
    picture = NetworkRenderer(network)
    lane = network.lanes["S_C_0"]
    (x, y0), (_, y1) = lane.shape[0], lane.shape[-1]
    slow, fast = (x, y0 + 0.3 * (y1 - y0)), (x, y0 + 0.7 * (y1 - y0))
    picture.draw(traffic((*slow, 0, 20, 0.0), (*fast, 0, 20, 99.0)), {})
    pixels = picture.pixels()
    assert pixels.dtype == np.uint8 and max(pixels.shape[:2]) == 1000
    assert all(side % 2 == 0 for side in pixels.shape[:2])
    for place, colour in ((slow, _SPEEDS[0]), (fast, _SPEEDS[-1])):
        row, column = at(picture, pixels, place[0], place[1] - 10)  # 10 m behind the bumper
        assert np.abs(pixels[row, column] / 255 - to_rgb(colour)).max() < 0.05
        ahead = at(picture, pixels, place[0], place[1] + 3)
        assert np.abs(pixels[ahead] / 255 - to_rgb(colour)).max() > 0.2
    picture.draw(traffic(), {})
    row, column = at(picture, picture.pixels(), slow[0], slow[1] - 10)
    assert np.abs(picture.pixels()[row, column] / 255 - to_rgb(_SPEEDS[0])).max() > 0.2


def test_heads_show_the_state_by_colour_and_by_form(network: Network) -> None:
    (item,) = network.intersections
    picture = NetworkRenderer(network, size_px=2000)
    count = max(link.index for link in item.links) + 1
    shown: dict[str, np.ndarray] = {}
    for letter, colour in (("r", _RED), ("G", _SIGNALS["G"]), ("y", _SIGNALS["y"])):
        picture.draw(traffic(), {item.id: letter * count})
        pixels = picture.pixels()
        shown[letter] = near(pixels[:-60], colour)  # below is the legend
        assert len(shown[letter]) > 10 * len(item.incoming_lanes)
        for other in {_RED, *_SIGNALS.values()} - {colour}:
            assert not len(near(pixels[:-60], other))
    places = {letter: set(map(tuple, found.tolist())) for letter, found in shown.items()}
    assert len(places["r"] & places["y"]) > 0.8 * len(places["r"])
    assert len(places["r"] & places["G"]) < 0.5 * len(places["G"])


def test_links_of_one_lane_have_heads_of_their_own() -> None:
    network = Network.read(load_scenario("single-v1"))
    (item,) = network.intersections
    picture = NetworkRenderer(network)
    lines, colours = picture._heads.shown({item.id: "r" * 99})
    assert len(lines) == len(item.links) == len(colours)
    ends = {tuple(np.round(line, 6).ravel()) for line in lines}
    assert len(ends) == len(lines)  # none hides another
    for states, colour in (("r" * 99, _RED), ("O" * 99, _OFF), ("o" * 99, _OFF), ("", _OFF)):
        assert set(picture._heads.shown({item.id: states})[1]) == {colour}


def test_names_are_written_where_there_is_room(network: Network) -> None:
    plain, named = (
        NetworkRenderer(network),
        NetworkRenderer(network, {"signal_0": network.intersections[0].id}),
    )
    for picture in (plain, named):
        picture.draw(traffic(), {})
    changed = np.argwhere((plain.pixels() != named.pixels()).any(axis=2))
    row, column = at(plain, plain.pixels(), *network.intersections[0].position)
    assert len(changed) > 100
    assert np.abs(changed - (row, column)).max() < 140
    NetworkRenderer(network, {"$\\frac{$": network.intersections[0].id}).pixels()  # no formula


def test_a_long_network_is_not_a_thread() -> None:
    network = Network.read(load_scenario("arterial1x5-v1"))
    pixels = NetworkRenderer(network, size_px=600).pixels()
    assert pixels.shape[1] == 600 and pixels.shape[0] >= 220


def test_an_environment_can_be_copied_after_it_was_drawn() -> None:
    env = parallel_env("single-v1", duration_s=30, render_mode="rgb_array")
    env.reset(seed=1)
    picture = env.render()
    env.close()
    copied = copy.deepcopy(env)
    copied.reset(seed=1)
    assert np.array_equal(copied.render(), picture)
    copied.close()


def test_a_large_network_is_drawn_with_all_its_vehicles() -> None:
    env = parallel_env("grid4x4-v1", render_mode="rgb_array")
    env.reset(seed=1)
    try:
        for _ in range(90):
            env.step(dict.fromkeys(env.agents, 0))
        picture: Any = env.render()
        assert picture.shape == (1000, 1000, 3)
        assert len(near(picture, _SPEEDS[0])) > 500  # it is full of standing vehicles
    finally:
        env.close()
