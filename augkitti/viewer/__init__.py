"""The viewer: pairs of a data set in, a folder of pages that a browser opens from disk out.

`columns` packs arrays into few bytes, `pair_data` says what a pair's page needs, `panes` finds what was seen through
windows, `thumbnail` draws the small pictures, `pages` writes HTML from the templates beside it, `to_rerun` sends a pair
to another program. What runs in the browser lies in `static`, as it is.
"""

from augkitti.viewer.columns import decode_columns, encode_columns
from augkitti.viewer.pages import IndexRow, write_index_page, write_pair_page, write_static_files
from augkitti.viewer.pair_data import PairData, pair_data, source_points

__all__ = [
    "IndexRow",
    "PairData",
    "decode_columns",
    "encode_columns",
    "pair_data",
    "source_points",
    "write_index_page",
    "write_pair_page",
    "write_static_files",
]
