"""`data_manifest.yaml` in: what KITTI holds, which names are one drive, and how a disk compares with it out.

The file stands at the top of the repository; the package carries it along through a link of the same name, so that
an installed wheel has its own copy.
"""

from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import yaml


@dataclass(frozen=True)
class TrackingSource:
    """The raw drive of which a tracking sequence is a part."""

    recording: str
    first_frame: int  # the drive's frame that the tracking sequence calls 0


@lru_cache(maxsize=1)
def load_manifest() -> dict[str, Any]:
    """The manifest as it is written."""
    text = (resources.files("augkitti") / "data_manifest.yaml").read_text(encoding="utf-8")
    content: dict[str, Any] = yaml.safe_load(text)
    return content


def odometry_recording(number: str) -> str | None:
    """The raw drive of an odometry sequence (`00`); None where it was not published (11 to 21)."""
    entry = load_manifest()["odometry"].get(number)
    return str(entry["recording"]) if entry else None


def tracking_source(number: str) -> TrackingSource | None:
    """The raw drive of a tracking training sequence (`0003`); None where we are not sure."""
    entry = load_manifest()["tracking"].get(number)
    return TrackingSource(str(entry["recording"]), int(entry["first_frame"])) if entry else None
