"""Folders of a checkout by the names that they have in the wheel, so that code for one runs in the other."""

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import CodeType, ModuleType

PACKAGE = "jaxplore."


def alias(folder: str) -> None:
    """Have `jaxplore.FOLDER` be the package `FOLDER`, and the modules in it the same modules, not copies.

    Args:
        folder: the package's name.

    Example:
        >>> import envs.base, jaxplore.envs.base
        >>> jaxplore.envs.base.EnvSpec is envs.base.EnvSpec
        True
    """
    finder = next((one for one in sys.meta_path if isinstance(one, Aliases)), None)
    if finder is None:
        finder = Aliases()
        sys.meta_path.insert(0, finder)
    finder.folders.add(folder)
    sys.modules[PACKAGE + folder] = importlib.import_module(folder)


class Aliases(MetaPathFinder, InspectLoader):
    """Finds `jaxplore.FOLDER.NAME` as `FOLDER.NAME`."""

    def __init__(self) -> None:
        self.folders: set[str] = set()

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """What there is of this name, in one of the folders."""
        real = fullname.removeprefix(PACKAGE)
        if real == fullname or real.partition(".")[0] not in self.folders:
            return None
        found = importlib.util.find_spec(real)
        if found is None:
            return None
        is_package = found.submodule_search_locations is not None
        return importlib.util.spec_from_loader(fullname, self, origin=found.origin, is_package=is_package)

    def exec_module(self, module: ModuleType) -> None:
        """Put the folder's own module in the place of the new, empty one."""
        sys.modules[module.__name__] = importlib.import_module(module.__name__.removeprefix(PACKAGE))

    def get_code(self, fullname: str) -> CodeType | None:
        """For `python -m`."""
        spec = importlib.util.find_spec(fullname.removeprefix(PACKAGE))
        return spec.loader.get_code(spec.name) if spec and isinstance(spec.loader, InspectLoader) else None

    def get_source(self, fullname: str) -> str | None:
        """The folder's own."""
        spec = importlib.util.find_spec(fullname.removeprefix(PACKAGE))
        return spec.loader.get_source(spec.name) if spec and isinstance(spec.loader, InspectLoader) else None
