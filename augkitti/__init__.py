"""Augmented KITTI: virtual cars with exact motion labels in real LiDAR scans; numpy arrays in and out."""

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from augkitti.augment_pair import augment_pair
    from augkitti.dataset import Dataset
    from augkitti.dataset import open_dataset as open

__version__ = "0.1.0"
__all__ = ["Dataset", "augment_pair", "open"]

_PLACES = {  # loaded on first use, so that `import augkitti` and `augkitti --help` stay light
    "Dataset": "augkitti.dataset:Dataset",
    "augment_pair": "augkitti.augment_pair:augment_pair",
    "open": "augkitti.dataset:open_dataset",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'augkitti' has no attribute {name!r}")
    return _load(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _load(name: str) -> Any:
    from importlib import import_module

    module, attribute = _PLACES[name].split(":")
    return getattr(import_module(module), attribute)


class _Package(ModuleType):
    """Keeps `augkitti.augment_pair` the function: importing the module of that name would put the module there."""

    @property
    def augment_pair(self) -> Any:
        return _load("augment_pair")

    @augment_pair.setter
    def augment_pair(self, module: ModuleType) -> None:
        pass


sys.modules[__name__].__class__ = _Package
