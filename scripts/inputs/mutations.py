"""Right inputs made wrong: structure, values, text, points, pictures."""

from __future__ import annotations

import copy
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np

from dlo_casadi.config import dump_yaml
from dlo_casadi.effects import EFFECTS, CableData

Random = np.random.Generator
# A node of plain data: what holds it, and under which key or index.
Spot = tuple[Any, Any]

# Stands for raw YAML text in plain data until it has been written.
_RAW = "<<{}>>"

# Every level holds ten of the level below: 10^8 items at the top.
_LAUGHS = "[" + ", ".join(f"&l{k} [{', '.join([f'*l{k - 1}'] * 10)}]" for k in range(1, 9)) + "]"
RAW_VALUES = (
    *("!!float abc", "!!timestamp x", "!!timestamp 2024-99-99", "!!int x", "!!bool maybe"),
    *("!!binary x", "!!binary aGVsbG8=", "!!set {a, b}", "!!omap [a: 1]", "!!python/name:os"),
    *("!!null x", "!!str [1]", "!!map x", "!unknown 1", "2024-01-01", "0x1F", "1_000", "1:30"),
    *("1" + 400 * "0", "1" + 5000 * "0", "1e400", "-1e308", "1e-300", "1e308", "-0.0", "1e-12"),
    *(".nan", ".inf", "-.inf", "null", "true", '""', "~", "0", "-1", "2", "0.5", "1e9", "1e5"),
    *('"\\0"', '"\\ud800"', '"\\e[31m"', '"\\U0001F600"', '"[/b]"', '"a\\nb"', "FILL_IN"),
    *("[]", "{}", "[[]]", "[0, 0, 0]", "[1e308, -1e308]", "[.nan, 0]", "{0: 0}", "{[1]: 2}"),
    *("&a [*a]", "&a {b: *a}", "*nowhere", "{<<: &m {name: x}, <<: *m}", "{<<: 5}"),
    f"[&l0 [x, x, x, x, x, x, x, x, x, x], {_LAUGHS}]",
    *(2000 * "[" + 2000 * "]", 60 * "[" + 60 * "]", 500 * "x", 5000 * "x", "[" + 3000 * "0," + "]"),
    *("/dev/zero", ".", "/", "..", "x/../session.yaml", "session.yaml", "pose_01.csv/x", "a.jpg"),
    *("free", "pinned", "clamped", "cw", "held_out", "centerlines", "images", "link", "cobyla"),
)
_FACTORS = (-1.0, 0.0, 1e-300, 1e-30, 1e-12, 1e-6, 1e-3, 0.1, 0.5, 2.0, 10.0, 1e3, 1e6, 1e9, 1e30)
# Values that may be meant: what is let in must be computed with.
MODEST = (-1.0, 0.0, 1e-3, 0.1, 0.5, 0.9, 1.1, 2.0, 10.0, 100.0, 1e3)


def spots(data: Any) -> Iterator[Spot]:
    """Every value in plain data, with what holds it."""
    keys = data if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    for key in keys:
        yield data, key
        yield from spots(data[key])


def pick(random: Random, choices: Any) -> Any:
    """One of them."""
    return choices[int(random.integers(len(choices)))]


def changed_values(document: dict[str, Any], random: Random, factors: Any = MODEST) -> str:
    """YAML with one to three numbers or words changed, as a user may."""
    document = copy.deepcopy(document)
    numbers = [s for s in spots(document) if isinstance(s[0][s[1]], int | float)]
    for _ in range(random.integers(1, 4)):
        holder, key = pick(random, numbers)
        value = holder[key]
        if isinstance(value, bool):
            holder[key] = not value
        elif isinstance(value, int):
            holder[key] = int(pick(random, (2, 3, 5, 9, 17, 33, 120)))
        else:
            holder[key] = value * pick(random, factors) + (pick(random, (0, 0, 0, 0.3, -0.3)))
    if random.random() < 0.3:
        _declare(document, random)
    return dump_yaml(document)


def _declare(document: dict[str, Any], random: Random) -> None:
    """Declare one more effect, with values of any size."""
    if "model" not in document:
        return
    effect = pick(random, sorted(EFFECTS))
    names = [q.name for q in EFFECTS[effect]().parameters(CableData(0.5, 0.2, 0.01, 0.3))]
    values = {
        name: {
            "value": float(pick(random, (-1, 1)) * 10.0 ** random.integers(-4, 4)),
            "fixed": bool(random.random() < 0.3),
        }
        for name in names
        if random.random() < 0.7
    }
    document["model"].setdefault("effects", []).append({"name": effect, "parameters": values})


def changed_structure(document: dict[str, Any], random: Random) -> str:
    """YAML with keys and values taken away, doubled, exchanged, renamed, replaced."""
    document, raw = copy.deepcopy(document), []
    for _ in range(random.integers(1, 4)):
        found = list(spots(document))
        if not found:
            break
        holder, key = pick(random, found)
        value = holder[key]
        kind = int(random.integers(9))
        if kind <= 2:
            holder[key] = _RAW.format(len(raw))
            raw.append(pick(random, RAW_VALUES))
        elif kind == 3 and isinstance(value, int | float) and not isinstance(value, bool):
            holder[key] = value * pick(random, _FACTORS)
        elif kind == 4:
            del holder[key]
        elif kind == 5:
            other, name = pick(random, found)
            holder[key] = copy.deepcopy(other.get(name) if isinstance(other, dict) else other)
        elif kind == 6 and isinstance(holder, dict):
            renamed = f"{key}"[:-1] if random.random() < 0.5 else pick(random, ("x", "<<", "1", ""))
            holder[renamed] = holder.pop(key)
        elif kind == 7 and isinstance(holder, list):
            holder.extend([copy.deepcopy(value)] * int(pick(random, (1, 2, 300))))
        else:
            holder[key] = [value] if random.random() < 0.5 else {str(key): value}
    text = dump_yaml(document)
    for k, replacement in enumerate(raw):
        for quoted in (f"'{_RAW.format(k)}'", _RAW.format(k)):
            text = text.replace(quoted, replacement)
    return text


_TOKENS = [
    *(b"\t", b"\n", b": ", b"- ", b"[", b"]", b"{", b"}", b"#", b"'", b'"', b"&a ", b"*a", b"|\n"),
    *(b"!!float ", b"!!int ", b"---\n", b"...\n", b"%YAML 9.9\n", b"\xff", b"\x00", b"\x85"),
    *(b"\xef\xbb\xbf", b"\r", b"  ", b"1e", b"-", b".", b",", b"? ", b"@", b"`", b"<<: "),
    b"\xf0\x9f\x98\x80",
]


def changed_text(content: bytes, random: Random) -> bytes:
    """Bytes with pieces cut, doubled, moved, replaced; any text file."""
    text = bytearray(content)
    for _ in range(int(random.integers(1, 6))):
        at = int(random.integers(len(text) + 1))
        end = min(len(text), at + int(pick(random, (1, 1, 3, 10, 40))))
        kind = int(random.integers(9))
        if kind == 0:
            del text[at:end]
        elif kind == 1:
            text[at:at] = text[at:end]
        elif kind == 2 and at < len(text):
            text[at] ^= 1 << int(random.integers(8))
        elif kind == 3:
            text[at:at] = pick(random, _TOKENS)
        elif kind == 4:
            text[at:at] = pick(random, RAW_VALUES).encode("utf-8", "replace")
        elif kind == 5 and random.random() < 0.2:
            del text[at:]
        elif kind == 6:
            lines = bytes(text).split(b"\n")
            i, j = random.integers(len(lines), size=2)
            lines[i], lines[j] = lines[j], lines[i]
            text = bytearray(b"\n".join(lines))
        elif kind == 7 and random.random() < 0.1:
            decoded = bytes(text).decode("utf-8", "replace")
            text = bytearray(
                decoded.encode(pick(random, ("utf-16", "utf-32", "latin-1", "cp037")), "replace")
            )
        else:
            text[at:at] = bytes(random.integers(256, size=3, dtype=np.uint8))
    return bytes(text)


# Some more than is read, and no more than can be made ten thousand times.
_MOST_ROWS, _MOST_BYTES = 5000, 30_000_000
_CELLS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e400", "1e-320", "1e5", "", " ", "x", "0x10"),
    *('"', '"0.1', '"0,1"', "0,1", "0;1", "\x00", "\u0661", "1_0", "=1+1"),
    *("1" * 5000, "1" * 200_000, "'" * 140_000),
)


def changed_points(content: bytes, random: Random) -> bytes:
    """A CSV with cells, rows, columns or the order of its points changed."""
    if random.random() < 0.3:
        return changed_text(content, random)
    rows = [line.split(",") for line in content.decode().splitlines()]
    for _ in range(int(random.integers(1, 4))):
        k = int(random.integers(len(rows)))
        kind = int(random.integers(10))
        if kind <= 2 and rows[k]:
            rows[k][int(random.integers(len(rows[k])))] = pick(random, _CELLS)
        elif kind == 3:
            rows[k] = rows[k] * int(pick(random, (0, 2, 1000)))
        elif kind == 4:
            rows[k:k] = [rows[k]] * int(pick(random, (1, 3, 2000)))
        elif kind == 5 and len(rows) > 2:
            del rows[1 + k :]
            rows = rows or [["x_m", "y_m"]]
        elif kind == 6:
            rows[1:] = [rows[1 + i] for i in random.permutation(len(rows) - 1)]
        elif kind == 7:
            factor = pick(random, (-1.0, 0.0, 1e-9, 1e-3, 0.5, 1.3, 1e2, 1e3, 1e200))
            rows[1:] = [[_scaled(cell, factor) for cell in row] for row in rows[1:]]
        elif kind == 8:
            rows[0] = pick(
                random, (["s_m", "x_m", "y_m"], ["x_m"], ["y_m", "x_m"], [""], ["0", "0"])
            )
        else:
            rows = [row[::-1] for row in rows]
    ending = pick(random, ("\n", "\r\n", "\r", "\n\n"))
    changed = ending.join(",".join(row) for row in rows[:_MOST_ROWS])
    return changed[:_MOST_BYTES].encode("utf-8", "replace")


def _scaled(cell: str, factor: float) -> str:
    try:
        return repr(float(cell) * factor)
    except ValueError:
        return cell


_ENDINGS = (".png", ".jpg", ".bmp", ".webp", ".tiff")


def changed_picture(content: bytes, random: Random) -> tuple[bytes, str]:
    """A picture of another size, depth or look, or its file damaged; and its ending."""
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    look: Callable[[], np.ndarray] = pick(
        random,
        (
            lambda: picture,
            lambda: picture,
            lambda: picture[:1, :1],
            lambda: picture[:, :2],
            lambda: picture[:17],
            lambda: picture[..., 0],
            lambda: np.rot90(picture, int(random.integers(4))),
            lambda: 255 - picture,
            lambda: np.zeros_like(picture),
            lambda: np.full_like(picture, 255),
            lambda: random.integers(256, size=picture.shape, dtype=np.uint8),
            lambda: picture.astype(np.uint16) * 257,
            lambda: np.dstack([picture, picture[..., 0]]),
            lambda: cv2.resize(picture, None, fx=0.1, fy=0.1),
            lambda: cv2.resize(picture, None, fx=3.0, fy=0.3),
            lambda: np.roll(picture, int(random.integers(320)), axis=1),
            lambda: cv2.GaussianBlur(picture, (0, 0), 6.0),
        ),
    )
    ending = pick(random, _ENDINGS)
    drawn = np.ascontiguousarray(look())
    if drawn.dtype == np.uint16 and ending not in (".png", ".tiff"):
        ending = ".png"
    data = cv2.imencode(ending, drawn)[1].tobytes()
    kind = int(random.integers(8))
    if kind == 0:
        data = data[: int(random.integers(len(data)))]
    elif kind == 1:
        data = _other_size(data, ending, random)
    elif kind == 2:
        data = changed_text(data, random)
    elif kind == 3:
        head = bytearray(data)
        for at in random.integers(min(len(head), 64), size=4):
            head[int(at)] = int(random.integers(256))
        data = bytes(head)
    elif kind == 4:
        data += bytes(random.integers(256, size=1000, dtype=np.uint8))
    return data, pick(random, _ENDINGS) if random.random() < 0.1 else ending


def _other_size(data: bytes, ending: str, random: Random) -> bytes:
    """The same file with another width and height in its header."""
    width, height = (int(pick(random, (0, 1, 100, 1000, 5000, 30_000, 65_535))) for _ in range(2))
    if ending == ".png":
        head = data[12:16] + struct.pack(">II", width * 1000, height) + data[24:29]
        return data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]
    if ending == ".bmp":
        return data[:18] + struct.pack("<ii", width, height) + data[26:]
    at = data.find(b"\xff\xc0")
    if ending == ".jpg" and at > 0:
        return data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]
    return data
