"""Croissant metadata: the index of a finished data set in, a JSON-LD description (Croissant 1.1) out.

Search engines and loaders of data sets read it: every shard with its size and sha256, every column with its type and
meaning (from `SCHEMA`), a record set a split. The file belongs beside the data set's folder or on the page that
publishes it, not into the folder, which holds what the contract names and nothing else.
"""

import datetime
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa

from augkitti.dataset_index import KITTI_LICENCE, STREET_LICENCE, DatasetIndex
from augkitti.shards import SCHEMA

VERSION = "http://mlcommons.org/croissant/1.1"
PARQUET = "application/x-parquet"
_LICENCES = {
    KITTI_LICENCE: "https://creativecommons.org/licenses/by-nc-sa/3.0/",
    STREET_LICENCE: "https://spdx.org/licenses/MIT.html",
}
_CITE_AS = (
    "@inproceedings{behl2019pointflownet, title={PointFlowNet: Learning Representations for Rigid Motion Estimation "
    "from Point Clouds}, author={Behl, Aseem and Paschalidou, Despoina and Donn{\\'e}, Simon and Geiger, Andreas}, "
    "booktitle={CVPR}, year={2019}} "
    "@article{geiger2013kitti, title={Vision meets Robotics: The KITTI Dataset}, author={Geiger, Andreas and Lenz, "
    "Philip and Stiller, Christoph and Urtasun, Raquel}, journal={International Journal of Robotics Research}, "
    "year={2013}}"
)
# The context that the specification prescribes, word for word: readers compare it.
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "name": {"@container": "@language"},
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_TYPES = {
    pa.string(): "sc:Text",
    pa.float32(): "cr:Float32",
    pa.float64(): "cr:Float64",
    pa.uint8(): "cr:UInt8",
    pa.uint16(): "cr:UInt16",
    pa.int16(): "cr:Int16",
    pa.int32(): "cr:Int32",
    pa.int64(): "cr:Int64",
}


def croissant(
    index: DatasetIndex,
    splits: Mapping[str, Sequence[str]] | None,
    name: str,
    address: str,
    published: datetime.date,
    url: str | None = None,
) -> dict[str, Any]:
    """The description as a JSON-LD document.

    Args:
        index: of the data set.
        splits: shard paths by split; None: one record set, `pairs`.
        name: of the data set.
        address: of its folder, from the folder in which the description will lie.
        published: the date to give.
        url: of the page that publishes it; None: the address.
    """
    groups = {k: tuple(paths) for k, paths in (splits or {"pairs": [s.path for s in index.shards]}).items() if paths}
    kitti = index.source.get("kind") == "kitti"
    used = {path for paths in groups.values() for path in paths}
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": VERSION,
        "name": name,
        "description": (
            "Pairs of neighbouring LiDAR scans with scene flow, objects and their rigid motions"
            + ("" if index.configuration.get("cars") == [0, 0] else "; virtual cars were cast into the scans")
            + (", which are KITTI's. " if kitti else ", which are procedural streets, not real ones. ")
            + f"Made by augkitti {index.program_version}, seed {index.seed}; shard contract {index.contract}. "
            + index.licence
        ),
        "license": _LICENCES.get(index.licence, index.licence),
        "url": url or address,
        "version": index.program_version,
        "datePublished": published.isoformat(),
        "citeAs": _CITE_AS,
        "creator": {"@type": "sc:Organization", "name": "The augkitti authors"},
        "keywords": ["lidar", "scene flow", "KITTI", "point clouds", "rigid motion", "simulation"],
        "distribution": [
            *(
                {
                    "@type": "cr:FileObject",
                    "@id": shard.path,
                    "name": shard.path.rpartition("/")[2],
                    "contentUrl": f"{address.rstrip('/')}/{shard.path}",
                    "contentSize": f"{shard.bytes} B",
                    "encodingFormat": PARQUET,
                    "sha256": shard.sha256,
                }
                for shard in index.shards
                if shard.path in used
            ),
            *(
                {
                    "@type": "cr:FileSet",
                    "@id": f"shards-{split}",
                    "name": f"shards-{split}",
                    "encodingFormat": PARQUET,
                    "includes": [f"{address.rstrip('/')}/{path}" for path in paths],
                }
                for split, paths in groups.items()
            ),
        ],
        "recordSet": [_record_set(split) for split in groups],
    }


def _record_set(split: str) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": split,
        "name": split,
        "description": "A record is a pair of scans." if split == "pairs" else f"The pairs of the split `{split}`.",
        "key": {"@id": f"{split}/pair_id"},
        "field": [_field(split, field) for field in SCHEMA],
    }


def _field(split: str, field: pa.Field) -> dict[str, Any]:
    source = {"fileSet": {"@id": f"shards-{split}"}, "extract": {"column": field.name}}
    told = _told(f"{split}/{field.name}", field)
    inner = field.type.value_type if pa.types.is_list(field.type) else field.type
    if not pa.types.is_struct(inner):
        return {**told, "dataType": _TYPES[inner], "source": source}
    return {
        **told,
        "source": source,
        "subField": [
            {
                **_told(f"{split}/{field.name}/{part.name}", part),
                "dataType": _TYPES[part.type.value_type if pa.types.is_list(part.type) else part.type],
                "source": {**source, "transform": {"jsonPath": part.name}},
            }
            for part in inner
        ],
    }


def _told(identifier: str, field: pa.Field) -> dict[str, Any]:
    told = {
        "@type": "cr:Field",
        "@id": identifier,
        "name": field.name,
        "description": field.metadata[b"meaning"].decode(),
    }
    return {**told, "isArray": True, "arrayShape": "-1"} if pa.types.is_list(field.type) else told
