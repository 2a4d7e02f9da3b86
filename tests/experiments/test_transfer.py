"""Runs that start from another run's policy: what comes with it, who warms up, and what is refused."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from experiments import run
from experiments.runs.command import parse
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.spec import RunRef, RunSpec, to_json
from experiments.runs.status import Status
from experiments.training import build, loop, parent
from jaxplore.methods import METHODS
from tests.experiments.corridor import ONWARDS, make_corridor
from tests.experiments.test_methods_run import make_task_point
from tests.experiments.tiny import leaves, rows, tiny_flags

EXPLORE = ("--env=task", "--method=disagreement", *tiny_flags("disagreement"), "--keep-at=25,50", "--num-seeds=2")
# Rounds of 25, 15 and 25 steps; the network's form is the parent's.
LEARN = ("--env=task", "--method=sac", "--preset=smoke", "--steps=65", "--warm-up-steps=40", "--checkpoint-every=20")
LEARN = (*LEARN, "--task-sac.batch-size=8", "--model-free.updates-per-round=2")


@pytest.fixture(autouse=True)
def task(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(envs.FACTORIES, "task", make_task_point)


@pytest.fixture(scope="module")
def explored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny run that explores, two seeds, 81 steps, checkpoints of 25, 50, 75 and 81. Not to be written to."""
    out = tmp_path_factory.mktemp("explored") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(envs.FACTORIES, "task", make_task_point)
        assert run.main([*EXPLORE, f"--out={out}"]) == 0
    return out


def explorer_of(out: Path, step: int | None = None):
    """The agent of a run, and the state of its first seed at a step."""
    directory = RunDirectory(out)
    env = build.make_env(directory.config())
    agent = build.make_agent(directory.config(), env)
    state, _ = loop.last_state(directory, env, agent, step)
    return agent, jax.tree.map(lambda leaf: leaf[0], state.explorer)


def same(a: object, b: object) -> None:
    assert all(jax.tree.leaves(jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), a, b)))


def test_checkpoints_are_kept_at_the_steps_that_are_named(explored: Path):
    # 25 and 50 for good; of the others the two latest
    assert RunDirectory(explored).checkpoints().steps() == [25, 50, 75, 81]


def test_the_form_of_the_policy_and_the_steps_that_are_left_come_from_the_parent(
    explored: Path, tmp_path: Path, capsys
):
    out = tmp_path / "child"
    words = [word for word in LEARN if not word.startswith("--steps")]
    assert run.main([*words, "--task-sac.lr=0.01", f"--parent={explored}@50", f"--out={out}"]) == 0
    assert f"550 steps after 50 of {explored}@50" in capsys.readouterr().out, "of the preset's 600"
    spec = RunDirectory(out).spec()
    own, theirs = spec.config.explorer.task_sac, RunDirectory(explored).config().explorer.sac
    form = ("hidden", "activation", "log_std_map", "log_std_min", "log_std_max")
    assert [getattr(own, name) for name in form] == [getattr(theirs, name) for name in form]
    assert own.hidden == (8,) and own.activation == "leaky_relu" and own.log_std_map == "tanh"
    assert (own.lr, own.alpha, own.reward_scale, own.init) == (0.01, 1.0, 5.0, "xavier"), "all else is the task's"
    assert spec.config.steps == 550 and spec.parent is not None and spec.parent.steps == 50
    assert rows(out)[-1]["step"] == 550, "its own steps"


def test_the_parents_policy_acts_to_the_bit_until_the_first_update(explored: Path, tmp_path: Path):
    out = tmp_path / "child"
    words = [*LEARN, "--warm-up=policy", f"--parent={explored}", "--keep-at=25,40", "--seed=5", f"--out={out}"]
    assert run.main(words) == 0
    (agent, before), (theirs, parents) = explorer_of(out, 25), explorer_of(explored)
    obs = jax.random.normal(jax.random.key(3), (64, 4))
    for how in ("act", "act_greedily"):
        mine, its = (
            jax.jit(getattr(one, how))(jax.random.key(1), one.actor(state), obs)
            for one, state in ((agent, before), (theirs, parents))
        )
        # what the explorer holds for the best is its mean; it is drawn where the task is learned
        if how == "act_greedily":
            np.testing.assert_array_equal(mine, its)
        else:
            assert not np.array_equal(mine, its)
    # the warm-up's actions are drawn from it, at the observations that there were
    rows_ = jax.tree.map(lambda leaf: leaf[:25], before.data.rows)
    greedy = jax.jit(agent.act_greedily)(jax.random.key(1), theirs.actor(parents), rows_.obs)
    drawn = np.asarray(rows_.action)
    assert int(before.data.size) == 25 and not np.array_equal(drawn, greedy)
    log_std = np.asarray(_gaussian(out, theirs.actor(parents), rows_.obs).log_std)
    noise = (np.arctanh(drawn.astype(float)) - np.arctanh(np.asarray(greedy, float))) / np.exp(log_std)
    assert np.abs(noise).max() < 5 and 0.5 < noise.std() < 1.5, "as the parent's own distribution has it"
    # nothing is learned before step 40, and then something is
    same(before.behaviour.params["policy"], parents.behaviour.learner.params["policy"])
    same(explorer_of(out, 25)[1].behaviour.opt_state, jax.tree.map(np.zeros_like, before.behaviour.opt_state))
    after = explorer_of(out, 40)[1].behaviour.params["policy"]["mlp"]["output"]["kernel"]
    assert not np.array_equal(after, before.behaviour.params["policy"]["mlp"]["output"]["kernel"])


def _gaussian(out: Path, actor, obs):
    from jaxplore import normalizer
    from jaxplore.learners.sac import make_networks
    from jaxplore.networks import apply

    networks = make_networks(4, 2, RunDirectory(out).config().explorer.task_sac)
    return apply(networks.policy, actor.behaviour, normalizer.normalize(actor.normalizers.obs, obs))


def test_uniform_actions_warm_up_where_they_are_asked_for(explored: Path, tmp_path: Path):
    # the same as those of a run without a parent: the key says which, and the policy nothing
    words = [*LEARN, "--keep-at=40", "--task-sac.hidden", "8"]
    assert run.main([*words, f"--parent={explored}", f"--out={tmp_path / 'child'}"]) == 0
    assert run.main([*words, f"--out={tmp_path / 'orphan'}"]) == 0
    child, orphan = (explorer_of(tmp_path / name, 40)[1] for name in ("child", "orphan"))
    same(child.data, orphan.data)
    assert np.abs(np.asarray(child.data.rows.action[:40])).std() == pytest.approx(12**-0.5, abs=0.06)


def test_without_a_warm_up_it_learns_from_the_first_round_on(explored: Path, tmp_path: Path):
    out = tmp_path / "child"
    words = [word for word in LEARN if not word.startswith("--warm-up-steps")]
    assert run.main([*words, "--warm-up=none", f"--parent={explored}", "--keep-at=25", f"--out={out}"]) == 0
    told = rows(out)
    assert [row["step"] for row in told] == [25, 50, 65]
    assert all("policy/q_loss" in row for row in told)
    _, first = explorer_of(out, 25)
    assert int(first.data.size) == 25, "it started empty"
    parents = explorer_of(explored)[1].behaviour.learner.params["policy"]["mlp"]["output"]["kernel"]
    moved = np.asarray(first.behaviour.params["policy"]["mlp"]["output"]["kernel"]) - np.asarray(parents)
    assert 0 < np.abs(moved).max() < 3e-3, "two updates away from the parent's policy, with steps of 3e-4"


@pytest.mark.slow
def test_statistics_stay_as_the_parent_had_them_and_only_there(explored: Path, tmp_path: Path):
    assert run.main([*LEARN, f"--parent={explored}", f"--out={tmp_path / 'child'}"]) == 0
    assert run.main([*LEARN, "--task-sac.hidden", "8", f"--out={tmp_path / 'orphan'}"]) == 0
    theirs, child, orphan = (explorer_of(out)[1] for out in (explored, tmp_path / "child", tmp_path / "orphan"))
    same(child.normalizers, theirs.normalizers)
    assert bool(child.frozen) and not bool(theirs.frozen) and not bool(orphan.frozen)
    assert float(orphan.normalizers.obs.count) == 65 and float(theirs.normalizers.obs.count) == 81
    # a grandchild has the child's, which are the first one's, and counts all steps before its own
    out = tmp_path / "grandchild"
    assert run.main([*LEARN, f"--parent={tmp_path / 'child'}", f"--out={out}"]) == 0
    same(explorer_of(out)[1].normalizers, theirs.normalizers)
    ref = RunDirectory(out).spec().parent
    assert ref is not None and (ref.step, ref.before, ref.steps) == (65, 81, 146)


def test_resumed_it_is_the_run_that_was_never_stopped(explored: Path, tmp_path: Path):
    words = [*LEARN, "--warm-up=policy", f"--parent={explored}"]
    assert run.main([*words, f"--out={tmp_path / 'whole'}"]) == 0
    shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    shutil.rmtree(tmp_path / "cut/checkpoints/65")
    (tmp_path / "cut/outcome.json").unlink()
    assert run.main([f"--out={tmp_path / 'cut'}", "--resume"]) == 0
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    assert leaves(tmp_path / "cut", 65) == leaves(tmp_path / "whole", 65)


def test_a_named_checkpoint_of_an_unfinished_run_will_do(explored: Path, tmp_path: Path, capsys):
    half = tmp_path / "half"
    shutil.copytree(explored, half)
    (half / "outcome.json").unlink()
    assert RunDirectory(half).status() is Status.PARTIAL
    assert run.main([*LEARN, f"--parent={half}", f"--out={tmp_path / 'child'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: --parent={str(half)!r} is not finished. Allowed: a run that is finished")
    assert line.endswith(f"or one of its checkpoints, such as {half}@81.")
    assert not (tmp_path / "child").exists()
    assert run.main([*LEARN, f"--parent={half}@50", f"--out={tmp_path / 'child'}"]) == 0


REFUSED = [
    (("--task-sac.hidden", "9"), "has a policy of another form (task_sac.hidden=(8,), not (9,)). Allowed: a run whose"),
    (("--task-sac.log-std-map=clip",), "another form (task_sac.log_std_map='tanh', not 'clip')"),
    (("--task-sac.activation=relu",), "or to leave out --task-sac.activation, which the parent decides on"),
    (("--model-free.no-normalize-obs",), "another form (model_free.normalize_obs=True, not False)"),
]


@pytest.mark.parametrize(("flags", "message"), REFUSED)
def test_what_the_parent_decides_on_is_refused_where_it_differs(
    flags: tuple[str, ...], message: str, explored: Path, tmp_path: Path, capsys
):
    assert run.main([*LEARN, *flags, f"--parent={explored}", f"--out={tmp_path / 'run'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: --parent={str(explored)!r} has a policy of") and message in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--warm-up=policy",), "--warm-up='policy' has no parent whose policy acts. Allowed: uniform, none"),
        (("--warm-up=non",), "--warm-up='non' is not known. Did you mean 'none'?"),
        (("--warm-up=none",), "--warm-up-steps=40 has nobody to act, with warm_up='none'. Allowed: 0, or another"),
        (("--keep-at=25,30",), "--keep-at=30 cannot be kept. Allowed: ends of rounds up to 65: multiples of steps_per"),
        (("--keep-at=25,x",), "--keep-at='x' is not a number"),
        (("--data-capacity=64",), "--data-capacity=64 is less than the run's 65 steps, so that the oldest data would"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(words, message: str, tmp_path: Path, capsys):
    assert run.main([*LEARN, *words, f"--out={tmp_path / 'run'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line, line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("which", ["random", "psne"])
def test_a_parent_without_such_a_policy_is_refused(which: str, tmp_path: Path, capsys):
    other = tmp_path / "other"
    assert run.main(["--env=task", f"--method={which}", *tiny_flags(which), f"--out={other}"]) == 0
    capsys.readouterr()
    assert run.main([*LEARN, f"--parent={other}", f"--out={tmp_path / 'run'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"has another kind of policy (method {which!r}). Allowed: a run whose method has a policy of SAC's" in line
    assert not (tmp_path / "run").exists()


def test_a_parent_that_diverged_is_refused(explored: Path, tmp_path: Path, capsys):
    broken, half = tmp_path / "broken", tmp_path / "half"
    for out, status in ((broken, "diverged"), (half, "finished")):
        shutil.copytree(explored, out)
        (out / "outcome.json").write_text(json.dumps({"status": status, "diverged": {}}))
        lines = (out / "metrics.jsonl").read_text().splitlines()
        kept = [json.loads(line) for line in lines]
        kept = [row for row in kept if (row["step"], row["seed"]) not in {(75, 1), (81, 1)}]
        next(row for row in reversed(kept) if row["seed"] == 1)["diverged"] = "q_loss"
        (out / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in kept))
    for ref, flags, message in (
        (broken, (), "diverged: its numbers are not finite. Allowed: a run that is finished"),
        (f"{broken}@50", (), "diverged: its numbers"),
        (half, ("--num-seeds=2",), "diverged in seed 1. Allowed: a run whose seeds are finite at that step"),
    ):
        assert run.main([*LEARN, *flags, f"--parent={ref}", f"--out={tmp_path / 'run'}"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert re.search(re.escape(message), line), line
        assert not (tmp_path / "run").exists()
    # its other seed, and what came before, are whole
    env = build.make_env(RunDirectory(half).config())
    config = child_of(explored)
    assert parent.resolve(RunRef(str(half)), env, build.make_agent(config, env), config).step == 81


def child_of(ref: Path | str, *words: str):
    """The configuration of a run of `LEARN`, changed by `words`, and what its parent decides on."""
    words = (*LEARN, *words, f"--parent={ref}")
    return run.inherited(parse(words)[1], words).config


def agent_of(config):
    return build.make_agent(config, build.make_env(config))


def damage(out: Path, step: int) -> Path:
    """Change a byte of the largest file of a checkpoint, which is given."""
    checkpoint = out / "checkpoints" / str(step)
    file = max(
        (path for path in (checkpoint / "state").rglob("*") if path.is_file()), key=lambda path: path.stat().st_size
    )
    held = bytearray(file.read_bytes())
    held[len(held) // 2] ^= 1
    file.write_bytes(held)
    return checkpoint


def files(out: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("at", "whole"), [("@50", "25, 75, 81"), ("", "25, 50, 75")])
def test_of_a_damaged_checkpoint_no_older_one_takes_the_place(
    at: str, whole: str, explored: Path, tmp_path: Path, capsys
):
    broken = tmp_path / "broken"
    shutil.copytree(explored, broken)
    checkpoint = damage(broken, 50 if at else 81)
    assert run.main([*LEARN, f"--parent={broken}{at}", f"--out={tmp_path / 'child'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: --parent={broken}{at}: the checkpoint {checkpoint} is damaged (state/")
    assert line.endswith(
        f"altered). What to do: put back a copy of it, or take another one: whole are those of step {whole}."
    )
    assert list(tmp_path.iterdir()) == [broken]


@pytest.mark.slow
def test_a_run_that_has_to_start_over_looks_at_its_parent_again(explored: Path, tmp_path: Path, capsys):
    source, child = tmp_path / "source", tmp_path / "child"
    shutil.copytree(explored, source)
    assert run.main([*LEARN, f"--parent={source}@50", f"--out={child}"]) == 0
    recorded = RunDirectory(child).spec().parent
    assert recorded is not None and recorded.identity == RunDirectory(source).spec().identity
    (child / "outcome.json").unlink()
    shutil.copytree(child, tmp_path / "later")
    shutil.rmtree(child / "checkpoints")
    before = files(child)
    # damaged since: nothing of the child is touched
    checkpoint = damage(source, 50)
    capsys.readouterr()
    assert run.main(["--resume", f"--out={child}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"the checkpoint {checkpoint} is damaged" in line and files(child) == before
    with pytest.raises(RunError, match=f"{checkpoint} is damaged"):
        parent.adopt(None, recorded, None)  # pyright: ignore[reportArgumentType]
    # another run in its place
    shutil.rmtree(source)
    assert run.main([*EXPLORE, "--seed=7", f"--out={source}"]) == 0
    other = RunDirectory(source).spec().identity
    capsys.readouterr()
    for words in (["--resume", f"--out={child}"], [f"--config={child / 'config.json'}", f"--out={tmp_path / 'again'}"]):
        assert run.main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(
            f"error: --parent='{source}@50' is another run by now: its identity is {other}, and that"
        )
        assert f"of the one started from {recorded.identity}. Allowed: that run, back in its place" in line
    assert files(child) == before and not (tmp_path / "again").exists()
    # with a checkpoint of its own it needs no parent
    shutil.rmtree(source)
    assert run.main(["--resume", f"--out={tmp_path / 'later'}"]) == 0
    # made longer it is another run, and what it was at that step the same
    shutil.copytree(explored, source)
    spec = RunDirectory(source).spec()
    RunDirectory(source).extend(dataclasses.replace(spec, config=dataclasses.replace(spec.config, steps=120)))
    assert RunDirectory(source).spec().identity != recorded.identity
    assert run.main(["--resume", f"--out={child}"]) == 0
    assert rows(child) == rows(tmp_path / "later")


def test_of_several_seeds_runs_the_record_is_theirs_together(explored: Path, tmp_path: Path, capsys):
    spec = RunDirectory(explored).spec()
    for place, identity in (("same", spec.identity), ("other", "0123456789abcdef")):
        source, config = tmp_path / place, tmp_path / f"{place}.json"
        source.mkdir()
        (source / "seeds.json").write_text(to_json(spec))
        child = RunSpec(child_of(explored), RunRef(str(source), None, identity))
        config.write_text(to_json(child))
        # side by side they have one parent: what is refused next
        assert run.main([f"--config={config}", f"--out={tmp_path / 'run'}"]) == 2
    same_, other = capsys.readouterr().err.splitlines()
    assert "holds a run for each of several seeds" in same_
    assert f"its identity is {spec.identity}, and that of the one started from 0123456789abcdef" in other


POINT = make_task_point()
VARIANTS = {
    "twin": {},
    "numbered": {"obs_names": tuple(f"obs[{i}]" for i in range(4))},
    "numbered_too": {"obs_names": tuple(f"obs[{i}]" for i in range(4))},
    "turned": {"action_names": ("y push", "x push")},
    "one_push": {"action_names": ("push",)},
}
"""The point with other entries."""


@pytest.fixture
def variants(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, changes in VARIANTS.items():
        spec = dataclasses.replace(POINT.spec, name=name, **changes)
        made = dataclasses.replace(POINT, spec=spec)
        monkeypatch.setitem(envs.FACTORIES, name, lambda backend="auto", obs_noise=0.0, made=made: made)


def move(explored: Path, env: str, to: Path) -> Path:
    """The run as if it had been in another environment."""
    shutil.copytree(explored, to)
    spec = RunDirectory(to).spec()
    config = dataclasses.replace(spec.config, env=env, backend="auto")
    (to / "config.json").write_text(to_json(dataclasses.replace(spec, config=config)))
    return to


@pytest.mark.parametrize(
    ("theirs", "own", "message"),
    [
        ("half_cheetah", "half_cheetah_task", "has 19 and 6. Allowed: a run with 17 observation entries and 6 action"),
        ("one_push", "task", "has 4 and 1. Allowed: a run with 4 observation entries and 2 action entries"),
        (
            *("gymnasium:Walker2d-v5", "half_cheetah_task"),
            "is of another environment, gymnasium:Walker2d-v5, whose observation entry 0 is 'obs[0]', not 'z above the "
            "start [m]'. Allowed: a run of half_cheetah_task, or of an environment whose entries have the same names",
        ),
        (
            "turned",
            "task",
            "is of another environment, turned, whose action entry 0 is 'y push', not 'x push'. Allowed",
        ),
        ("numbered_too", "numbered", "another environment, numbered_too, whose observation entries are only numbered"),
    ],
)
@pytest.mark.usefixtures("variants")
def test_a_parent_of_another_environment_is_refused(
    theirs: str, own: str, message: str, explored: Path, tmp_path: Path, capsys
):
    other = move(explored, theirs, tmp_path / "other")
    assert run.main([*LEARN, f"--env={own}", f"--parent={other}", f"--out={tmp_path / 'run'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: --parent={str(other)!r} ") and message in line, line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("theirs", "own"), [("twin", "task"), ("numbered", "numbered")])
@pytest.mark.usefixtures("variants")
def test_a_parent_with_the_same_entries_will_do(theirs: str, own: str, explored: Path, tmp_path: Path):
    other = move(explored, theirs, tmp_path / "other")
    config = child_of(other, f"--env={own}")
    assert parent.resolve(RunRef(str(other)), build.make_env(config), agent_of(config), config).step == 81


@pytest.mark.slow
def test_a_policy_by_gradient_ascent_is_handed_on_with_its_form(tmp_path: Path, capsys):
    climbed, method = tmp_path / "climbed", "disagreement_grad"
    form = ("--gradient.activation=tanh", "--gradient.log-std-max=1", "--gradient.no-act-greedily")
    assert run.main(["--env=task", f"--method={method}", *tiny_flags(method), *form, f"--out={climbed}"]) == 0
    capsys.readouterr()
    config = child_of(climbed)
    sac = config.explorer.task_sac
    found = (sac.hidden, sac.activation, sac.log_std_map, sac.log_std_min, sac.log_std_max)
    assert found == ((8,), "tanh", "tanh", -5.0, 1.0)
    (theirs, state), own = explorer_of(climbed), agent_of(config)
    adopted = own.adopt(own.init(jax.random.key(0)), theirs.actor(state))
    obs, key = jax.random.normal(jax.random.key(3), (64, 4)), jax.random.key(1)
    drawn, expected = (
        jax.jit(agent.act)(key, agent.actor(one), obs) for agent, one in ((own, adopted), (theirs, state))
    )
    np.testing.assert_array_equal(drawn, expected)
    for flag, message in (
        ("--task-sac.activation=relu", "task_sac.activation='tanh', not 'relu'"),
        ("--task-sac.log-std-max=2", "task_sac.log_std_max=1.0, not 2.0"),
        ("--task-sac.log-std-map=clip", "task_sac.log_std_map='tanh', not 'clip'"),
    ):
        assert run.main([*LEARN, flag, f"--parent={climbed}", f"--out={tmp_path / 'run'}"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"has a policy of another form ({message})" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("method", ["maxinfo", "maxinfo_implicit", "rnd_sac"])
def test_whatever_method_has_a_policy_that_lasts_takes_one_over(method: str, explored: Path):
    words = [word for word in LEARN if "sac" not in word and "model-free" not in word]
    words = [*words, f"--method={method}", f"--parent={explored}"]
    config = run.inherited(parse(words)[1], words).config
    (theirs, state), own = explorer_of(explored), agent_of(config)
    assert own.adopt is not None
    adopted = own.adopt(own.init(jax.random.key(0)), theirs.actor(state))
    obs = jax.random.normal(jax.random.key(3), (64, 4))
    mine, its = (
        jax.jit(agent.act_greedily)(jax.random.key(1), agent.actor(one), obs)
        for agent, one in ((own, adopted), (theirs, state))
    )
    np.testing.assert_array_equal(mine, its)


def test_a_run_is_given_a_replay_that_holds_all_its_steps():
    capacity = lambda *words: parse(["--method=random", *words])[1].config.explorer.data_capacity  # noqa: E731
    assert capacity() == capacity("--steps=9000") == 10_001
    assert capacity("--steps=20000") == 20_001
    assert capacity("--steps=20000", "--data-capacity=20000") == 20_000


PARENT = ("--env=corridor", "--method=onwards", "--preset=smoke", "--num-seeds=3", "--steps=500", "--warm-up-steps=100")
PARENT = (
    *PARENT,
    "--sac.alpha=0.002",
    "--fit.steps=60",
    "--imagination.updates-per-rollout=100",
    "--imagination.restart-every=0",
    "--imagination.real-fraction=0",
    "--imagination.keep-imagined",
)
CHILD = ("--env=corridor", "--method=sac", "--preset=smoke", "--num-seeds=3", "--steps=300", "--warm-up-steps=200")
CHILD = (*CHILD, "--task-sac.alpha=0.02", "--eval-every=300", "--eval-episodes=2")


@pytest.mark.slow
def test_exploration_finds_the_only_reward_and_sac_alone_does_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # three seeds: who starts from the policy that walked on meets the reward at the far end in its warm-up and keeps it
    # when it learns; who starts from nothing has met none by then, and cannot know of any
    monkeypatch.setitem(envs.FACTORIES, "corridor", make_corridor)
    monkeypatch.setitem(METHODS, "onwards", ONWARDS)
    explored, child, alone = (tmp_path / name for name in ("explored", "child", "alone"))
    assert run.main([*PARENT, f"--out={explored}"]) == 0
    assert run.main([*CHILD, f"--parent={explored}", "--warm-up=policy", f"--out={child}"]) == 0
    assert run.main([*CHILD, f"--out={alone}"]) == 0
    for seed in range(3):
        mine, others = ([row for row in rows(out) if row["seed"] == seed] for out in (child, alone))
        returns, none = ([row["episode_return"] for row in of if "episode_return" in row] for of in (mine, others))
        assert len(returns) == len(none) == 6
        assert min(returns[:4]) > 5 and mine[-1]["eval/return"] > 5
        assert none == [0.0] * 6 and others[-1]["eval/return"] == 0
