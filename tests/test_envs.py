"""The Gymnasium environments: what they promise, and that the tools around Gymnasium agree."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium import error
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordEpisodeStatistics, RecordVideo, TimeLimit

import turgor
from turgor.control import rows
from turgor.envs.registration import ENVIRONMENTS

NAMES = list(ENVIRONMENTS)
# every mass is outside of such a cage after the first step
OPEN_CAGE = {"cage_width": 0.1, "cage_wall": 0.1}


def wave(t: int, outputs: int = 11) -> np.ndarray:
    """An action that makes the body move."""
    return np.sin(t / 9 + 0.7 * np.arange(outputs)).astype(np.float32)


def played(env: gymnasium.Env, steps: int, first: int = 0) -> list[Any]:
    """What `steps` steps return, in a form that can be compared bit by bit."""
    out = []
    for t in range(first, first + steps):
        observation, *rest = env.step(wave(t, env.action_space.shape[0]))
        out.append((observation.tobytes(), *rest))
    return out


# --- what is promised --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_finds_nothing_wrong(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    check_env(gymnasium.make(name).unwrapped)


@pytest.mark.parametrize("name", NAMES)
def test_stable_baselines_finds_nothing_wrong(name: str) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(gymnasium.make(name).unwrapped)


@pytest.mark.parametrize(
    ("body", "condition", "observations", "actions"),
    [("small", "pressure", 33, 11), ("small", "springs", 33, 10), ("large", "pressure", 63, 21)],
)
def test_spaces(body: str, condition: str, observations: int, actions: int) -> None:
    env = gymnasium.make("turgor/Flat-v0", body=body, condition=condition)
    assert env.observation_space == gymnasium.spaces.Box(-1.0, 1.0, (observations,), np.float32)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32)
    observation, _ = env.reset(seed=0)
    assert observation.dtype == np.float32
    assert env.step(env.action_space.sample())[0] in env.observation_space


@pytest.mark.parametrize("name", NAMES)
def test_rewards_add_up_to_the_fitness_of_a_rollout(name: str) -> None:
    """Springs at rest and a steady rise of pressure: commands that a controller without weights gives, too."""
    env = gymnasium.make(name, body="medium").unwrapped
    env.reset(seed=5)
    action = np.zeros(16, dtype=np.float32)
    action[-1] = 0.125
    rewards, over, info = [], False, {}
    while not over:
        _, reward, terminated, over, info = env.step(action)
        rewards.append(reward)
        assert not terminated
    theta = np.zeros((1, env.task.parameter_count))
    theta[0, -1] = 0.125
    out = turgor.Simulator(env.task).rollout(theta)
    assert len(rewards) == 1800
    assert info["fitness"] == pytest.approx(out.fitness[0], rel=1e-12, abs=1e-15)
    assert sum(rewards) == pytest.approx(30 * info["fitness"], rel=1e-9, abs=1e-9)
    assert info["fitness"] != 0


def test_agent_does_what_the_simulator_does() -> None:
    env = gymnasium.make("turgor/Hilly-v0").unwrapped
    first, info = env.reset(seed=3)
    task = turgor.make_task("hilly", seed=info["terrain"], pressure_unit=env.task.pressure_unit)
    assert task.identity == env.task.identity
    simulator = turgor.Simulator(task)
    stand = simulator.reset(1)
    assert first.tobytes() == stand.observation[0].tobytes()
    share, x = task.body.mass / task.body.mass.sum(), []
    for t in range(300):
        observation, reward, _, _, info = env.step(wave(t))
        before, stand = stand, simulator.step(wave(t)[None])
        assert observation.tobytes() == np.clip(stand.observation[0], -1, 1).tobytes()
        x.append([float(s.position[0, :, 0].astype(np.float64) @ share) for s in (before, stand)])
        assert reward == pytest.approx(x[-1][1] - x[-1][0], abs=1e-12)
        assert info["pressure"] == stand.pressure[0, 0]
        assert info["area_ratio"] == pytest.approx(task.body.area(stand.position)[0, 0] / task.area_reference[0])
        assert info["fitness"] == pytest.approx((x[-1][1] - x[0][0]) / 30, abs=1e-12)


def test_contacts_are_counted() -> None:
    env = gymnasium.make("turgor/Flat-v0", condition="springs")
    _, info = env.reset(seed=0)
    assert info["contacts"] == 0
    rest, counts = np.zeros(10, dtype=np.float32), []
    for _ in range(60):
        observation, _, _, _, info = env.step(rest)
        counts.append(info["contacts"])
    assert 2 <= counts[-1] <= 6
    assert observation[:10].sum() == pytest.approx(np.mean(counts[-25:]), rel=1e-6)


def test_pressure_crosses_its_range_in_half_a_second() -> None:
    for body in ("small", "large"):
        env = gymnasium.make("turgor/Flat-v0", body=body).unwrapped
        env.reset(seed=0)
        low, high = env.task.pressure_range[0]
        action = np.zeros(env.action_space.shape, dtype=np.float32)
        pressures = []
        for command in [-1.0] * 30 + [1.0] * 30 + [-2.0] * 15:
            action[-1] = command
            pressures.append(env.step(action)[4]["pressure"])
        assert pressures[29] == pytest.approx(low)
        assert pressures[58] < high * 0.999
        assert pressures[59] == pytest.approx(high)
        assert pressures[-1] == pytest.approx((low + high) / 2)  # actions are cut at -1
    slow = gymnasium.make("turgor/Flat-v0", pressure_unit=7.0).unwrapped
    assert slow.task.pressure_step[0] == 7.0


# --- episodes ----------------------------------------------------------------------------------------------------


def test_same_seed_same_episode() -> None:
    one, other = gymnasium.make("turgor/Hilly-v0"), gymnasium.make("turgor/Hilly-v0")
    first, info = one.reset(seed=7)
    again, same = other.reset(seed=7)
    assert (first.tobytes(), info) == (again.tobytes(), same)
    assert played(one, 200) == played(other, 200)
    # the next terrains follow from the seed, too
    terrains = [[env.reset()[1]["terrain"] for _ in range(3)] for env in (one, other)]
    assert terrains[0] == terrains[1]
    assert len({info["terrain"], *terrains[0]}) == 4
    assert one.reset(seed=8)[1]["terrain"] != info["terrain"]
    assert one.reset(seed=7)[1]["terrain"] == info["terrain"]


def test_terrain_of_ones_choice() -> None:
    env = gymnasium.make("turgor/Hilly-v0", seed_terrain=4)
    assert [env.reset(seed=s)[1]["terrain"] for s in (0, 1, None)] == [4, 4, 4]
    expected = turgor.make_task("hilly", seed=4).scene.segments
    np.testing.assert_array_equal(env.unwrapped.task.scene.segments, expected)
    assert "terrain" not in gymnasium.make("turgor/Flat-v0").reset(seed=0)[1]


def test_solved_escape_terminates() -> None:
    env = gymnasium.make("turgor/Escape-v0", **OPEN_CAGE)
    _, info = env.reset(seed=0)
    assert info["is_success"] is False
    _, _, terminated, truncated, info = env.step(wave(0))
    assert (terminated, truncated, info["is_success"]) == (True, False, True)
    with pytest.raises(error.ResetNeeded, match="not over"):
        env.step(wave(1))
    env.reset()
    env.step(wave(0))


def test_controller_escapes_step_by_step() -> None:
    """Controllers that get out of a cage with a high opening in a rollout get out of it in the environment."""
    env = gymnasium.make("turgor/Escape-v0", cage_aperture=10.5).unwrapped
    theta = np.random.default_rng(0).uniform(-1, 1, (200, env.task.parameter_count))
    out = turgor.Simulator(env.task).rollout(theta)
    weights, biases = rows(theta[out.solved], env.task.body, "pressure")
    solved = 0
    for weight, bias in zip(weights[:5], biases[:5], strict=True):
        observation, _ = env.reset(seed=0)
        gain, over, terminated, info = 0.0, False, False, {}
        while not over:
            action = weight @ observation + bias
            action[:-1] = np.tanh(action[:-1])
            observation, reward, terminated, truncated, info = env.step(action)
            gain, over = gain + reward, terminated or truncated
        assert info["is_success"] == terminated
        assert gain == pytest.approx(30 * info["fitness"])
        solved += terminated
        if terminated:
            assert info["fitness"] > 7 / 30  # from the middle to beyond the wall
    assert solved >= 1


def test_length_of_an_episode() -> None:
    env = gymnasium.make("turgor/Flat-v0", steps=7)
    assert env.spec.max_episode_steps == 7
    env.reset(seed=0)
    assert [step[3] for step in played(env, 7)] == [False] * 6 + [True]
    assert gymnasium.make("turgor/Flat-v0").spec.max_episode_steps == 1800
    # a TimeLimit may only shorten it, and the two agree where they are equal
    for env in (
        gymnasium.make("turgor/Flat-v0", max_episode_steps=7),
        TimeLimit(gymnasium.make("turgor/Flat-v0"), 7),
        gymnasium.make(gymnasium.make("turgor/Flat-v0", steps=7).spec),
    ):
        env.reset(seed=0)
        assert [step[3] for step in played(env, 7)] == [False] * 6 + [True]
        assert env.spec.max_episode_steps == 7


def test_elapsed_time_counts_if_asked_for() -> None:
    env = gymnasium.make("turgor/Flat-v0", fitness="elapsed")
    env.reset(seed=0)
    rewards = sum(step[1] for step in played(env, 90))
    info = env.step(wave(90))[4]
    assert info["fitness"] * 91 / 60 == pytest.approx(rewards, abs=0.2)


def test_bodies_of_ones_own() -> None:
    """Two chambers: two pressure commands, and a value for each of them."""
    half = [0, 1, 2, 3, 4, 5], [5, 6, 7, 8, 9, 0]
    body = turgor.Body(turgor.SMALL.position, springs=turgor.SMALL.springs, chambers=half, gas_amount=700.0)
    env = gymnasium.make("turgor/Flat-v0", body=body)
    assert env.action_space.shape == (12,)
    _, info = env.reset(seed=0)
    assert info["pressure"].shape == info["area_ratio"].shape == (2,)
    action = np.zeros(12, dtype=np.float32)
    action[-1] = -1.0
    _, _, _, _, later = env.step(action)
    assert (later["pressure"] < info["pressure"]).tolist() == [False, True]
    plain = turgor.Body(turgor.SMALL.position, springs=turgor.SMALL.springs)
    env = gymnasium.make("turgor/Flat-v0", body=plain, condition="springs")
    assert env.reset(seed=0)[1]["pressure"].shape == (0,)


# --- wrappers, copies, pictures ----------------------------------------------------------------------------------


@pytest.mark.parametrize("how", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_copy_goes_on_alike(how: Any, render_mode: str | None) -> None:
    env = gymnasium.make("turgor/Hilly-v0", render_mode=render_mode)
    fresh = how(env)
    env.reset(seed=2)
    assert fresh.reset(seed=2)[1] == env.reset(seed=2)[1]
    played(env, 60)
    twin = how(env)
    if render_mode:
        np.testing.assert_array_equal(env.render(), twin.render())
    assert played(env, 60, first=60) == played(twin, 60, first=60)
    assert env.reset()[1] == twin.reset()[1]
    assert played(env, 5) == played(twin, 5)


def test_copy_of_an_episode_that_is_over() -> None:
    env = gymnasium.make("turgor/Escape-v0", **OPEN_CAGE)
    env.reset(seed=0)
    env.step(wave(0))
    with pytest.raises(error.ResetNeeded, match="not over"):
        copy.deepcopy(env).step(wave(1))


def test_statistics() -> None:
    env = RecordEpisodeStatistics(gymnasium.make("turgor/Flat-v0", steps=20))
    env.reset(seed=0)
    *before, last = played(env, 20)
    assert last[4]["episode"]["l"] == 20
    assert last[4]["episode"]["r"] == pytest.approx(sum(step[1] for step in [*before, last]))


def test_video_can_be_played(tmp_path: Path) -> None:
    env = gymnasium.make("turgor/Hilly-v0", steps=30, seed_terrain=0, render_mode="rgb_array", render_size=(320, 180))
    env = RecordVideo(env, str(tmp_path / "videos"))
    env.reset(seed=0)
    played(env, 30)
    env.close()
    (path,) = tmp_path.glob("videos/*.mp4")
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
        assert container.streams.video[0].average_rate == 60
    assert len(frames) in (30, 31)  # MoviePy sometimes leaves the last one out
    assert (frames[0].width, frames[0].height) == (320, 180)
    assert (frames[0].to_ndarray(format="rgb24") != frames[-1].to_ndarray(format="rgb24")).any()


def test_pictures() -> None:
    env = gymnasium.make("turgor/Escape-v0", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert (first.shape, first.dtype) == ((360, 640, 3), np.uint8)
    played(env, 40)
    later = env.render()
    assert (first != later).any()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), first)
    assert gymnasium.make("turgor/Flat-v0", dt=1 / 30).metadata["render_fps"] == 30
    frames = gymnasium.make("turgor/Flat-v0", render_mode="rgb_array_list")
    frames.reset(seed=0)
    played(frames, 3)
    assert len(frames.render()) == 4


def test_camera_follows() -> None:
    """However fast the body is, it stays in the picture."""
    from turgor.envs.rendering import Canvas

    task = turgor.make_task("flat")
    canvas, stand = Canvas(task, (320, 180)), turgor.Simulator(task).reset(1)
    for t in range(120):
        moved = stand.position + np.float32([0.5 * t, 3 * np.sin(t / 5)])
        canvas.add(msgspec.structs.replace(stand, position=moved))
        pixels = canvas.painter.camera.pixels(t, moved[0])
        assert (pixels > 0).all()
        assert (pixels < (320, 180)).all()


def test_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    env = gymnasium.make("turgor/Flat-v0", render_mode="human")
    env.reset(seed=0)
    assert pygame.display.get_surface().get_size() == (640, 360)
    assert env.render() is None
    played(env, 3)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, env.unwrapped._canvas.frame())
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_pictures_need_no_display() -> None:
    run(
        "import gymnasium, turgor, pygame, os\n"
        "env = gymnasium.make('turgor/Flat-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "assert env.render().any()\n"
        "assert not pygame.display.get_init()\n"
    )


# --- what is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"gravty": 9.81}, "unknown keyword 'gravty'; did you mean gravity?"),
        ({"seed_terain": 1}, "did you mean seed_terrain?"),
        ({"xyz": 1}, "unknown keyword 'xyz'; expected one of area_min, baumgarte"),
        ({"gravity": "much"}, "gravity: expected a number; got 'much'"),
        ({"body": "huge"}, "body: expected one of small, medium, large; got 'huge'"),
        ({"condition": "passive"}, "condition: expected one of pressure, springs; got 'passive'"),
        ({"seed_terrain": -1}, "seed_terrain: expected a whole number, 0 or more; got -1"),
        ({"seed_terrain": 1.5}, "seed_terrain: expected a whole number"),
        ({"render_size": (10, 10)}, "render_size: expected"),
        ({"task": "steep"}, "task: expected one of hilly"),
    ],
)
def test_impossible_environment(keywords: dict[str, Any], message: str) -> None:
    with pytest.raises(error.Error, match=message.replace("?", r"\?")) as caught:
        gymnasium.make("turgor/Hilly-v0", **keywords)
    assert "\n" not in str(caught.value)


def test_terrain_where_there_is_none() -> None:
    for name in NAMES[1:]:
        with pytest.raises(error.Error, match=r"seed_terrain: expected None, because \w+ has no random terrain"):
            gymnasium.make(name, seed_terrain=0)


def test_impossible_actions() -> None:
    env = gymnasium.make("turgor/Flat-v0")
    env.reset(seed=0)
    for action, message in (
        (np.zeros(10), r"shape \[11\], within \[-1, 1\]; got shape \[10\]"),
        (np.zeros((1, 11)), r"got shape \[1, 11\]"),
        (np.array([0.0] * 10 + [np.nan]), r"got nan at \[10\]"),
        (np.array([np.inf] + [0.0] * 10), r"got inf at \[0\]"),
        (["left"] * 11, "got .*left"),
        (None, r"got shape \[\]"),
    ):
        with pytest.raises(error.InvalidAction, match=message):
            env.step(action)
    beyond, within = copy.deepcopy(env), env
    assert beyond.step(3 * wave(0))[1:] == within.step(np.clip(3 * wave(0), -1, 1))[1:]


def test_steps_out_of_turn() -> None:
    for env in (gymnasium.make("turgor/Flat-v0"), gymnasium.make("turgor/Flat-v0").unwrapped):
        with pytest.raises(error.ResetNeeded, match="reset"):
            env.step(wave(0))
    env = gymnasium.make("turgor/Flat-v0", render_mode="rgb_array").unwrapped
    with pytest.raises(error.ResetNeeded, match="reset"):
        env.render()
    with pytest.raises(error.Error, match="options: expected none"):
        env.reset(options={"terrain": 3})
    env = gymnasium.make("turgor/Flat-v0", steps=1)
    env.reset(seed=0)
    env.step(wave(0))
    with pytest.raises(error.ResetNeeded, match="not over"):
        env.step(wave(1))


def test_unknown_render_mode() -> None:
    with (
        pytest.warns(UserWarning, match="not in the possible render_modes"),
        pytest.raises(error.UnsupportedMode, match="expected None, human or rgb_array; got 'ansi'"),
    ):
        gymnasium.make("turgor/Flat-v0", render_mode="ansi")
    env = gymnasium.make("turgor/Flat-v0").unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


# --- registration ------------------------------------------------------------------------------------------------


def run(code: str) -> None:
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(
    "imports",
    [
        "import gymnasium, turgor",
        "import turgor, gymnasium",
        "import turgor\nfrom gymnasium.envs.registration import registry\nimport gymnasium",
        "import turgor, importlib.util\nassert importlib.util.find_spec('gymnasium')\nimport gymnasium",
        "import turgor.envs.scalar, gymnasium",
    ],
)
def test_import_of_turgor_is_enough(imports: str) -> None:
    run(
        f"{imports}\n"
        f"assert {NAMES} == [name for name in gymnasium.registry if name.startswith('turgor/')]\n"
        "assert 'Source' in type(gymnasium.__loader__).__name__ and gymnasium.__spec__.loader is gymnasium.__loader__\n"
        "gymnasium.make('turgor/Flat-v0').reset(seed=0)\n"
    )


def test_turgor_is_imported_by_name() -> None:
    run("import gymnasium\ngymnasium.make('turgor:turgor/Hilly-v0').reset(seed=0)\n")


def test_import_of_turgor_waits_for_nothing() -> None:
    run("import sys, turgor\nassert not {'gymnasium', 'numpy', 'numba'} & set(sys.modules)\n")


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_several_in_gymnasiums_own_vector_environments(mode: str) -> None:
    envs = gymnasium.make_vec(
        "turgor/Hilly-v0",
        num_envs=2,
        vectorization_mode=mode,
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        steps=5,
    )
    first, info = envs.reset(seed=11)
    assert info["terrain"][0] != info["terrain"][1]
    alone = gymnasium.make("turgor/Hilly-v0", steps=5)
    assert alone.reset(seed=12)[0].tobytes() == first[1].tobytes()
    for t in range(5):
        observation, _, _, truncated, info = envs.step(np.stack([wave(t), wave(t)]))
    *_, last = played(alone, 5)
    assert truncated.all()
    assert info["final_obs"][1].tobytes() == last[0]
    assert info["final_info"]["fitness"][1] == last[4]["fitness"]
    assert observation[1].tobytes() == alone.reset()[0].tobytes()
    envs.close()
