"""Environments by their names."""

import pytest

import envs
from jaxplore.validate import FieldError


def test_make_by_name():
    assert envs.make("ant_maze", backend="mujoco", obs_noise=0.02).spec.name == "ant_maze"


def test_make_refuses_what_it_does_not_know():
    with pytest.raises(ValueError, match=r"'ant_mase' .*Did you mean 'ant_maze'\?"):
        envs.make("ant_mase")
    with pytest.raises(ValueError, match=r"option of 'ant_maze'='obs_nois' .*Did you mean 'obs_noise'\? Allowed: "):
        envs.make("ant_maze", obs_nois=0.1)


def test_every_refusal_knows_its_field():
    for name, options, field in (
        ("ant_mase", {}, "env"),
        ("gymnasim:Pendulum-v1", {}, "env"),
        ("gymnasium:Pendulum-v9", {}, "env"),
        ("ant_maze", {"backend": "mujocoo"}, "backend"),
        ("acrobot", {"obs_noise": -1.0}, "obs_noise"),
        ("nchain", {"obs_noise": 0.1}, "obs_noise"),
    ):
        with pytest.raises(FieldError) as refusal:
            envs.make(name, **options)
        assert refusal.value.field == field


def test_backends_are_those_that_can_be_asked_for():
    assert envs.backends("ant_maze") == envs.backends("hand_block") == ("mjx", "mujoco")
    assert envs.backends("nchain") == ("jax",)
    assert envs.backends("brax:fast") == ("generalized", "mjx", "positional", "spring")
    for name in envs.FACTORIES:
        for backend in envs.backends(name):
            assert backend in ("jax", *envs.base.ENGINES)


def test_backends_of_an_environment_that_does_not_mind_are_its_own(monkeypatch):
    chain = envs.make("nchain")
    monkeypatch.setitem(envs.FACTORIES, "easy_going", lambda backend="auto": chain)
    assert envs.backends("easy_going") == ("jax",)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dt": 0.0}, r"EnvSpec\.dt=0\.0 is out of range\. Allowed: a finite number in \(0, inf\)"),
        ({"episode_steps": 0}, r"EnvSpec\.episode_steps=0 is out of range"),
        ({"obs_names": ()}, r"EnvSpec\.obs_names=\(\) names nothing\. Allowed: one or more names"),
        ({"obs_names": ("a", "")}, r"EnvSpec\.obs_names=\('a', ''\) names nothing"),
        ({"name": ""}, r"EnvSpec\.name='' names nothing\. Allowed: a name"),
        ({"dt": float("nan")}, r"EnvSpec\.dt=nan is out of range"),
        ({"action_names": "push"}, r"EnvSpec\.action_names='push' names nothing"),
        ({"obs_limits": ((0.0, 1.0),)}, r"EnvSpec\.obs_limits=.* are 1\. Allowed: 2 pairs"),
    ],
)
def test_a_spec_that_no_environment_has_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        envs.EnvSpec(
            **{"name": "x", "obs_names": ("a", "b"), "action_names": ("c",), "episode_steps": 3, "dt": 0.1, **changes}
        )
