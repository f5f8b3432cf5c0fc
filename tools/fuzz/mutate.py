"""Damage: random changes of a valid file's bytes, or of its decoded values so that checks of the outer form pass."""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import PurePath
from typing import Any

import yaml

_NUMBERS = (
    *("0", "-1", "1", "2", "255", "65536", "-2147483648", "2147483648", "4294967296", "9223372036854775807"),
    *(
        "-9223372036854775808",
        "18446744073709551616",
        "1000000000000",
        "9" * 5000,
        "1e30",
        "-1e30",
        "1e-30",
        "1e308",
    ),
    *("1e999", "nan", "-inf", "NaN", "Infinity", "0x10", "1_000", "1.5", "-0.0", ".", "--1", "٣"),
)
_TEXTS = (
    *(
        "",
        " ",
        "\0",
        "a\0b",
        "../../etc/passwd",
        "/etc/passwd",
        "/dev/zero",
        "..",
        ".",
        "~",
        "con",
        "a/b",
        "x" * 10_000,
    ),
    *(
        "<script>alert(1)</script>",
        "[/red]",
        "[bold]",
        "\x1b[31m",
        "\r\n",
        "\u202e",
        "é",
        "🚗",
        "\ud800",
        "%s%n",
        "{0}",
    ),
    *(
        "None",
        "true",
        "null",
        "- a",
        "&a",
        "*a",
        "!!python/object/apply:os.system [ls]",
        "[" * 10_000,
        "{" * 10_000,
    ),
)
_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 0.5, -0.5, 1e30, -1e30, 1e-30, 1e308, float("nan"), float("inf"), 255, 256),
    *(
        1 << 16,
        1 << 31,
        (1 << 31) - 1,
        1 << 32,
        (1 << 63) - 1,
        -(1 << 63),
        1 << 63,
        10**12,
        10**40,
        [],
        {},
        [[]],
        [None],
    ),
    *([0] * 3, [1e30] * 4, [0] * 5000, {"a": {}}, {"dtype": "float64", "values": []}, [[1, 2], [3]], "1", "nan"),
)
_SIZES = (
    0,
    1,
    2,
    3,
    7,
    8,
    127,
    128,
    255,
    256,
    32767,
    65535,
    65536,
    1 << 24,
    1 << 30,
    (1 << 31) - 1,
    1 << 31,
    (1 << 32) - 1,
)

Damage = Callable[[bytes, random.Random], bytes]


def mutate(name: str, data: bytes, rng: random.Random) -> bytes:
    """Mutated bytes of the file `name`, by the form of its suffix."""
    own = _BY_SUFFIX.get(PurePath(name).suffix.lower())
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        chosen = raw if own is None or rng.random() < 0.3 else own
        try:
            data = chosen(data, rng)
        except (
            ValueError,
            LookupError,
            ArithmeticError,
            AttributeError,
            TypeError,
            EOFError,
            OSError,
            RuntimeError,  # of zipfile too, for a version or method that it does not know
            struct.error,
            zipfile.BadZipFile,
            zlib.error,
            yaml.YAMLError,
        ):
            data = raw(data, rng)  # an earlier change left nothing to parse
    return data


def raw(data: bytes, rng: random.Random) -> bytes:
    """Bytes flipped, cut, doubled, moved, or replaced by numbers that are often the last of their kind."""
    if not data:
        return bytes(rng.randrange(256) for _ in range(rng.choice((1, 4, 64))))
    at = rng.randrange(len(data)) if rng.random() < 0.6 else rng.randrange(min(len(data), 256))
    end = min(len(data), at + rng.choice((1, 2, 4, 8, 64, 1024)))
    part = data[at:end]
    kind = rng.randrange(8)
    if kind == 0:
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == 1:
        return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
    if kind == 2:
        return data[:at]
    if kind == 3:
        return data[:at] + data[end:]
    if kind == 4:
        return data[:at] + part * rng.choice((2, 2, 100)) + data[end:]
    if kind == 5:
        width = rng.choice(("<H", ">H", "<I", ">I", "<Q"))
        limit = 1 << 8 * struct.calcsize(width)
        number = struct.pack(width, rng.choice(_SIZES) % limit)
        return data[:at] + number + data[at + len(number) :]
    if kind == 6:
        to = rng.randrange(len(data))
        return data[:to] + part + data[to:]
    return data[:at] + rng.choice(_TEXTS).encode("utf-8", "surrogatepass") + data[at:]


def text(data: bytes, rng: random.Random) -> bytes:
    """Words and lines of text replaced, dropped, doubled, exchanged."""
    lines = data.decode("latin-1").split("\n")
    at = rng.randrange(len(lines))
    kind = rng.randrange(7)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines[at:at] = [lines[at]] * rng.choice((1, 1, 20))
    elif kind == 2:
        other = rng.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    else:
        words = lines[at].split(" ") if " " in lines[at] or rng.random() < 0.5 else lines[at].split("=")
        sign = " " if " " in lines[at] else "="
        place = rng.randrange(len(words))
        if kind == 3:
            del words[place]
        elif kind == 4:
            words.insert(place, words[rng.randrange(len(words))])
        else:
            words[place] = rng.choice(_NUMBERS if kind == 5 or rng.random() < 0.5 else _TEXTS)
        lines[at] = sign.join(words)
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def value(data: Any, rng: random.Random) -> Any:
    """What JSON or YAML holds, with one value, at any depth, that is another, doubled, gone, or renamed."""
    places = list(_places(data))
    if not places:
        return rng.choice(_VALUES)
    holder, key = rng.choice(places)
    kind = rng.randrange(8)
    if kind == 0 and isinstance(holder, dict):
        holder[rng.choice(("", "x", "../x", key + "x", "\ud800", "<b>"))] = holder.pop(key)
    elif kind == 1:
        del holder[key]
    elif kind == 2 and isinstance(holder, list):
        holder.insert(key, holder[key])
    elif kind == 3:
        other_holder, other_key = rng.choice(places)
        holder[key] = other_holder[other_key]
        if holder[key] is data or _holds(holder[key], holder):
            holder[key] = None
    elif kind == 4:
        holder[key] = rng.choice(_TEXTS)
    elif kind == 5 and isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
        holder[key] = rng.choice((holder[key] * 2, -holder[key], holder[key] + 1, str(holder[key]), [holder[key]]))
    elif kind == 6:
        deep: Any = holder[key]
        for _ in range(rng.choice((1, 2, 50))):
            deep = [deep] if rng.random() < 0.5 else {"a": deep}
        holder[key] = deep
    else:
        holder[key] = rng.choice(_VALUES)
    return data


def _places(data: Any) -> Any:
    """(list or object, index or key) of every value inside."""
    if isinstance(data, dict | list):
        for key in list(data) if isinstance(data, dict) else range(len(data)):
            yield data, key
            yield from _places(data[key])


def _holds(value: Any, part: Any) -> bool:
    return value is part or any(holder[key] is part for holder, key in _places(value))


def _json(data: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.2:
        return text(data, rng)
    return json.dumps(value(json.loads(data), rng)).encode()


def _yaml(data: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.4:
        return text(data, rng)
    return yaml.safe_dump(value(yaml.safe_load(data), rng), sort_keys=False).encode("utf-8", "surrogatepass")


def _png(data: bytes, rng: random.Random) -> bytes:
    """A chunk changed, with a checksum that is right."""
    at, chunks = 8, []
    while at + 12 <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        chunks.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + length]])
        at += 12 + length
    chosen = rng.choice(chunks)
    if rng.random() < 0.2:
        chunks.insert(rng.randrange(len(chunks)), list(rng.choice(chunks)))
    elif chosen[0] == b"IDAT" and rng.random() < 0.7:
        chosen[1] = zlib.compress(raw(zlib.decompress(chosen[1]), rng))
    else:
        chosen[1] = raw(chosen[1], rng)
    parts = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return data[:8] + b"".join(parts)


def _archive(data: bytes, rng: random.Random) -> bytes:
    """A member of a ZIP archive changed, the archive whole; or a member's size in its directory."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(members))
    kind = rng.randrange(5)
    if kind == 0:
        members[rng.choice(("", "../x.npy", "x", name + "x"))] = members.pop(name)
    elif kind == 1:
        del members[name]
    elif kind == 2:
        head = members[name]
        number = rng.choice((b"0", b"-1", b"1000000000000", b"9" * 30, b"(", b"True", b"2"))
        digits = [i for i, c in enumerate(head[10:128], 10) if 48 <= c < 58] or [10]
        at = rng.choice(digits)
        members[name] = head[:at] + number + head[at + len(number) :]
    elif kind == 3:
        members[name] = members[name][:128] + raw(members[name][128:], rng)
    else:
        members[name] = raw(members[name], rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for member, content in members.items():
            archive.writestr(zipfile.ZipInfo(member), content)
    packed = buffer.getvalue()
    if rng.random() < 0.1:
        at = packed.index(b"PK\x01\x02") + rng.choice((20, 24))
        packed = packed[:at] + struct.pack("<I", rng.choice(_SIZES)) + packed[at + 4 :]
    return packed


def _glb(data: bytes, rng: random.Random) -> bytes:
    """The JSON of a GLB changed, or its numbers, with lengths that are right."""
    (length,) = struct.unpack("<I", data[12:16])
    head, rest = data[20 : 20 + length], data[20 + length :]
    if rng.random() < 0.8:
        head = json.dumps(value(json.loads(head), rng)).encode()
        head += b" " * (-len(head) % 4)
    else:
        rest = rest[:8] + raw(rest[8:], rng)
    whole = 12 + 8 + len(head) + len(rest)
    return struct.pack("<4sII", b"glTF", 2, whole) + struct.pack("<I4s", len(head), b"JSON") + head + rest


def _safetensors(data: bytes, rng: random.Random) -> bytes:
    """The header of a safetensors file changed, or a value of its metadata, which often is JSON itself."""
    (length,) = struct.unpack("<Q", data[:8])
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    facts = header.get("__metadata__", {})
    if facts and rng.random() < 0.6:
        name = rng.choice(list(facts))
        old = facts[name].encode()
        facts[name] = (_json if old[:1] in (b"[", b"{") else text)(old, rng).decode("utf-8", "replace")
    else:
        header = value(header, rng)
    packed = json.dumps(header).encode()
    return struct.pack("<Q", len(packed)) + packed + body


_BY_SUFFIX: dict[str, Damage] = {
    ".json": _json,
    ".gltf": _json,
    ".yaml": _yaml,
    ".png": _png,
    ".npz": _archive,
    ".pth": _archive,
    ".glb": _glb,
    ".safetensors": _safetensors,
    **dict.fromkeys((".txt", ".cfg", ".names", ".obj", ".mtl", ".ply", ".csv"), text),
}
