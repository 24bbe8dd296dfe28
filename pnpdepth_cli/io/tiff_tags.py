"""Tags of a TIFF or of EXIF, which has the same form."""

from __future__ import annotations

import struct
from collections import defaultdict

_LETTER_OF_TYPE = {1: "B", 2: "B", 3: "H", 4: "I", 5: "Q", 7: "B", 10: "q", 11: "f", 12: "d"}


def read_tags(data: bytes) -> defaultdict[int, tuple[int, ...]]:
    """Returns the numbers of each tag of the first page; none for one that is absent.

    Thousands of tags can share the same bytes, which libraries copy for each.

    Raises:
        ValueError: The tags together claim more bytes than there are.
        struct.error: A tag points outside the data.
    """
    order = "<" if data[:2] == b"II" else ">"
    (start,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, start)
    end = start + 2 + 12 * count
    struct.unpack_from(f"{order}I", data, end)  # where the next page is: the list is complete
    tags: defaultdict[int, tuple[int, ...]] = defaultdict(tuple)
    claimed = 0
    for entry in range(start + 2, end, 12):
        tag, kind, number = struct.unpack_from(f"{order}HHI", data, entry)
        layout = f"{order}{number}{_LETTER_OF_TYPE.get(kind, 'B')}"
        size = struct.calcsize(layout)
        claimed += size
        if claimed > len(data):
            raise ValueError(f"its tags claim more than {len(data):,} bytes")
        (where,) = (entry + 8,) if size <= 4 else struct.unpack_from(f"{order}I", data, entry + 8)
        tags[tag] = struct.unpack_from(layout, data, where)
    return tags
