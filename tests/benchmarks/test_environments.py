"""Which environments are measured, and how their steps are counted."""

import pytest

import envs
from benchmarks import environments


def test_every_environment_of_ours_is_measured_on_every_backend_that_it_offers(monkeypatch):
    monkeypatch.setitem(envs.FACTORIES, "made_up", envs.FACTORIES["acrobot"])
    for backend in environments.BACKENDS:
        monkeypatch.setitem(environments.BACKENDS, backend, lambda name, quick, on=backend: [(name, on)])
    measured = list(environments.environments(quick=True))
    assert len(set(measured)) == len(measured)
    assert {name for name, _ in measured} == set(envs.FACTORIES)
    assert {("made_up", "jax"), ("ant_maze", "mujoco"), ("ant_maze", "mjx")} < set(measured)
    assert ("acrobot", "mujoco") not in measured


def test_environments_on_the_host_and_on_the_device_are_counted_in_steps_of_one(monkeypatch):
    monkeypatch.setattr(environments, "HOST_STEPS", 5)
    monkeypatch.setattr(environments, "MODES", ("sync",))
    monkeypatch.setattr(environments, "JAX_SIZES", (3,))
    one, vector = environments.BACKENDS["mujoco"]("half_cheetah", True)
    assert (one.kernel, one.shape) == ("half_cheetah, C MuJoCo", "1 in parallel")
    assert (vector.kernel, vector.shape) == ("half_cheetah, C MuJoCo, Gymnasium sync", "4 in parallel")
    (device,) = environments.BACKENDS["jax"]("nchain", True)
    assert (device.kernel, device.shape) == ("nchain, JAX", "3 in parallel")
    for result in (one, vector, device):
        assert result.per_second == pytest.approx(1 / result.seconds)
