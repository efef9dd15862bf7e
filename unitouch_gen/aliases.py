"""Other names of the package's modules, so that no class exists twice."""

import pkgutil
import sys
from importlib import import_module


def alias_package(name: str) -> None:
    """Makes `name` and its modules other names of `unitouch_gen.<name>` and its modules.

    `pipelines/` and `training/` lie at the root of a clone, so `import pipelines` finds them there.
    """
    package = import_module(f"unitouch_gen.{name}")
    sys.modules[name] = package
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not module.name.endswith("__main__"):  # runs a command
            sys.modules[module.name.removeprefix("unitouch_gen.")] = import_module(module.name)
