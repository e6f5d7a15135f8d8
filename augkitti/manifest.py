"""`data_manifest.yaml` in: the raw drives of data set K, and which names of other KITTI benchmarks are the same drive.

The file stands at the top of the repository; the package carries it along through a link of the same name, so that
an installed wheel has its own copy.
"""

from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import yaml


@dataclass(frozen=True)
class Drive:
    """One raw drive as the manifest knows it."""

    name: str  # the recording: 2011_09_26_drive_0005
    category: str
    archive: str  # where to download it
    archive_bytes: int
    frames: int | None  # length, where the drive's own timestamps were seen
    frames_unconfirmed: int | None  # length as commonly stated
    missing_scans: tuple[int, ...]
    tracklets_archive: str | None
    calib_archive: str  # of the day
    odometry: str | None
    tracking: str | None


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


def drives() -> tuple[Drive, ...]:
    """Every raw drive of data set K, by name."""
    content = load_manifest()
    source = content["source"]
    return tuple(
        Drive(
            name=name,
            category=entry["category"],
            archive=f"{source}/{name}/{entry['archive']}",
            archive_bytes=entry["archive_bytes"],
            frames=entry["frames"],
            frames_unconfirmed=entry.get("frames_unconfirmed"),
            missing_scans=tuple(entry["missing_scans"] or ()),
            tracklets_archive=f"{source}/{name}/{name}_tracklets.zip" if entry["tracklets"] else None,
            calib_archive=f"{source}/{name[:10]}_calib.zip",
            odometry=entry["odometry"],
            tracking=entry["tracking"],
        )
        for name, entry in sorted(content["raw"].items())
    )


def odometry_recording(number: str) -> str | None:
    """The raw drive of an odometry sequence (`00`); None where it was not published (11 to 21)."""
    entry = load_manifest()["odometry"].get(number)
    return str(entry["recording"]) if entry else None


def tracking_source(number: str) -> TrackingSource | None:
    """The raw drive of a tracking training sequence (`0003`); None where we are not sure."""
    entry = load_manifest()["tracking"].get(number)
    return TrackingSource(str(entry["recording"]), int(entry["first_frame"])) if entry else None
