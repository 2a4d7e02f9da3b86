"""Has Gymnasium know our environments without an import: `gymnasium.make("jaxplore/AntMaze-v0")`.

Gymnasium 1.0 took its entry point for plug-ins away. So the wheel brings `jaxplore.pth`, by which Python imports this
file when it starts, as `_jaxplore_gymnasium`, and calls `wait`. That imports nothing, and takes 0.2 ms: once somebody
imports Gymnasium it registers names, which cost nothing before one of them is made.
"""

import sys

IDS = {
    "jaxplore/Acrobot-v0": "acrobot",
    "jaxplore/AntMaze-v0": "ant_maze",
    "jaxplore/HalfCheetah-v0": "half_cheetah",
    "jaxplore/HalfCheetahTask-v0": "half_cheetah_task",
    "jaxplore/HalfCheetahTransfer-v0": "half_cheetah_transfer",
    "jaxplore/HandBlock-v0": "hand_block",
    "jaxplore/MountainCar-v0": "mountain_car",
    "jaxplore/NChain-v0": "nchain",
}
"""As `gymnasium_id` spells them; a test compares."""
ENTRY_POINT = "jaxplore.envs.adapters.to_gymnasium:GymnasiumEnv"


def wait():
    """Have Gymnasium registered to as soon as somebody imports it. Python may call this twice."""
    if not any(isinstance(one, Waiting) for one in sys.meta_path):
        sys.meta_path.insert(0, Waiting())


class Waiting:
    """A finder of modules that finds Gymnasium as the others do, and has it registered to when it has been imported."""

    def find_spec(self, fullname, path=None, target=None):
        """Gymnasium's spec; None for anything else."""
        if fullname != "gymnasium":
            return None
        # Those behind it alone, so that two which ask the others never ask each other.
        behind = sys.meta_path[sys.meta_path.index(self) + 1 :] if self in sys.meta_path else sys.meta_path[:]
        others = (getattr(one, "find_spec", None) for one in behind)
        spec = next(filter(None, (find(fullname, path, target) for find in others if find)), None)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def exec_module(module):
                run(module)
                register(module)
                if self in sys.meta_path:
                    sys.meta_path.remove(self)

            spec.loader.exec_module = exec_module
        return spec


def register(gymnasium):
    """Register the environments.

    Example:
        >>> import gymnasium
        >>> register(gymnasium)
        >>> gymnasium.spec("jaxplore/AntMaze-v0").kwargs
        {'name': 'ant_maze'}
    """
    for env_id, name in IDS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, ENTRY_POINT, kwargs={"name": name})
