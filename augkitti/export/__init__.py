"""Exports: the pairs of a finished data set in, a folder in the form that other people's programs read out.

A module a format, each a pure function from a pair to the bytes of its files; `writing.py` is the only one that touches
the disk. What each format cannot hold is in docs/exports.md.
"""

from augkitti.export.av2 import AV2
from augkitti.export.hplflownet import HPLFLOWNET
from augkitti.export.kitti_object import KITTI_OBJECT
from augkitti.export.opensceneflow import OPENSCENEFLOW
from augkitti.export.semantickitti import SEMANTICKITTI
from augkitti.export.target import Format, Scene
from augkitti.export.writing import Export, export_pairs, open_export

FORMATS = {form.name: form for form in (OPENSCENEFLOW, AV2, SEMANTICKITTI, KITTI_OBJECT, HPLFLOWNET)}

__all__ = ["FORMATS", "Export", "Format", "Scene", "export_pairs", "open_export"]
