"""Augmented KITTI: virtual cars with exact motion labels in real LiDAR scans; numpy arrays in and out."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from augkitti.augmentation import augment_pair
    from augkitti.dataset import Dataset
    from augkitti.dataset import open_dataset as open

__version__ = "0.1.0"
__all__ = ["Dataset", "augment_pair", "open"]

_PLACES = {  # loaded on first use, so that `import augkitti` and `augkitti --help` stay light
    "Dataset": "augkitti.dataset:Dataset",
    "augment_pair": "augkitti.augmentation:augment_pair",
    "open": "augkitti.dataset:open_dataset",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'augkitti' has no attribute {name!r}")
    module, attribute = _PLACES[name].split(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
