"""Atomic writes, and reads with errors that name the file. Imports no torch.

Files may come from anywhere: only regular files up to a size limit are read, and sizes that a file declares are
checked before anything is allocated.
"""

from __future__ import annotations

import codecs
import errno
import filecmp
import gzip
import hashlib
import io
import json
import math
import os
import re
import secrets
import shutil
import stat
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from scene_ir.errors import FormatError, ShapeError, WriteError

if TYPE_CHECKING:
    from PIL.Image import Image

_NPZ_LEVEL = 1
"""zlib level: higher ones hardly shrink float maps and take several times as long."""

_MAX_BYTES = 1 << 30
"""Size limit of a file that is read whole, and of all arrays of an NPZ."""
_CHUNK_BYTES = 1 << 24
"""Bytes per read of a file that is longer than its reported size."""
_MAX_LIST_BYTES = 1 << 33
"""Size limit of a JSON list that is read item by item."""
_MAX_PIXELS = 1 << 26
"""Size limit of an image: 8192 x 8192."""
_MAX_YAML_BYTES = 1 << 18
"""Size limit of a YAML file: configurations are short, and parsing is slow."""
_INTEGER_LIMIT = 1 << 63
"""Integers must fit int64 arrays."""
_INTEGER_DIGITS = len(str(_INTEGER_LIMIT))
_MAX_YAML_DIGITS = 200
"""Length limit of an integer in YAML, which may be binary, with underscores."""
_INVALID_ESCAPE = re.compile(r"\\u(?:[dD][89a-fA-F]|0000)")
"""JSON escapes of half a surrogate pair and of NUL: neither is valid in a name or can be written again."""


_LEFTOVER_NAME = re.compile(r"\.(.+)\.[0-9a-f]{8}\.tmp")


def _temporary_path(path: Path) -> Path:
    """An unused hidden name in the folder of `path`, on the same file system, so that a rename is atomic."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


def is_leftover(name: str) -> bool:
    """Whether a file or folder of this name is being written, or was when its process was killed."""
    return _LEFTOVER_NAME.fullmatch(name) is not None


def find_leftovers(folder: Path) -> list[Path]:
    """Temporary files and folders below `folder`, outermost only.

    Processes that are writing now have some too, which may vanish meanwhile.
    """
    leftovers: list[Path] = []
    for place, folders, names in os.walk(folder):
        leftovers += [Path(place, name) for name in (*folders, *names) if is_leftover(name)]
        folders[:] = [name for name in folders if not is_leftover(name)]
    return sorted(leftovers)


@contextmanager
def name_write_errors(path: Path) -> Iterator[None]:
    """Convert OSErrors while writing `path` to WriteErrors that name its final path."""
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        names = (found[1] if (found := _LEFTOVER_NAME.fullmatch(part)) else part for part in path.parts)
        raise WriteError(str(Path(*names)), (error.strerror or str(error)).lower()) from error


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically, and make its folder. Raises WriteError, as all writers here do."""
    write_parts(path, (data,))


def write_parts(path: Path, parts: Iterable[bytes]) -> None:
    """Write parts of a file atomically, one by one, and make its folder.

    Makes as few system calls as possible: tens of thousands of small files are written at once.
    """
    temporary = _temporary_path(path)
    with name_write_errors(path):
        try:
            stream = temporary.open("wb")
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            stream = temporary.open("wb")
        try:
            with stream:
                for part in parts:
                    stream.write(part)
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def hardlink_duplicates(folder: Path, other: Path) -> None:
    """Replace files below `folder` by hard links to equal files of the same name below `other`, if supported.

    Files of this project are replaced and never modified in place, so that a change of one does not affect the
    other.
    """
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        twin = other / path.relative_to(folder)
        if not twin.is_file() or path.samefile(twin) or not filecmp.cmp(path, twin, shallow=False):
            continue
        temporary = _temporary_path(path)
        try:
            os.link(twin, temporary)
            os.replace(temporary, path)
        except OSError:  # another file system, or one without links
            return
        finally:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically. Floats round-trip; ValueError if one is not finite."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image as PNG, atomically.

    Args:
        path: The file.
        image: (H, W, 3) RGB or (H, W), uint8 or uint16.
    """
    import cv2

    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise ShapeError(str(path), "(H, W, 3) or (H, W) of uint8 or uint16", f"{image.shape} of {image.dtype}")
    ok, encoded = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not ok:
        raise FormatError(str(path), "an image that PNG can hold", f"{image.shape} of {image.dtype}")
    write_bytes(path, encoded.tobytes())


def write_npz(path: Path, arrays: Mapping[str, np.ndarray], compressed: bool = True) -> None:
    """Write named arrays as an NPZ, atomically; equal arrays give equal bytes."""
    buffer, method = io.BytesIO(), zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer, "w", method, compresslevel=_NPZ_LEVEL) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(array).reshape(array.shape), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy")  # dated 1980, so that bytes do not depend on the clock
            archive.writestr(entry, member.getvalue(), method, _NPZ_LEVEL)
    write_bytes(path, buffer.getvalue())


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that replaces `folder` when the block ends without error."""
    temporary = _temporary_path(folder)
    with name_write_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
    try:
        yield temporary
        with name_write_errors(folder):
            _replace_folder(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _replace_folder(temporary: Path, folder: Path) -> None:
    """Move `temporary` to `folder`, which is restored if that fails.

    Of two processes that do so at once, the later one's folder remains.
    """
    done = False
    while not done:
        old = _temporary_path(folder)
        with suppress(FileNotFoundError):
            os.replace(folder, old)
        try:
            os.replace(temporary, folder)
            done = True
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):  # no other process came between
                if os.path.lexists(old):
                    os.replace(old, folder)
                raise
        if os.path.lexists(old):
            _remove(old)


def _remove(path: Path) -> None:
    """Delete a folder with its contents, a file or a link."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def sha256_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal. Raises FormatError if it cannot be read."""
    return hashlib.sha256(read_bytes(path)).hexdigest()


def check_model_card(path: Path, data: bytes) -> None:
    """Raise FormatError unless the weights `data` have the SHA-256 of the model card next to `path`."""
    card = path.with_suffix(".md")
    expected = re.search(r"SHA-256: `([0-9a-f]{64})`", read_text(card))
    found = hashlib.sha256(data).hexdigest()
    if expected is None or expected[1] != found:
        digest = expected[1] if expected else "which has none"
        raise FormatError(str(path), f"the SHA-256 of {card.name}, {digest}", found)


def resolve_inside(folder: Path, name: str) -> Path:
    """The path of `name` in `folder`. Raises FormatError if it leads out: by an absolute name, `..`, or a link."""
    parts = Path(name).parts
    if not parts or Path(name).is_absolute() or ".." in parts or "\0" in name:
        raise FormatError(str(folder), "names of what is in there", repr(name))
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FormatError(str(path), f"a file in {folder}", f"a link to {path.resolve()}")
    return path


def check_links(folder: Path) -> None:
    """Raise FormatError for a link in `folder`, or in a folder in it, that leads out of it."""
    for place, folders, names in os.walk(folder):
        for name in (*folders, *names):
            path = Path(place, name)
            if path.is_symlink():
                resolve_inside(folder, str(path.relative_to(folder)))


def check_regular_file(path: Path | str, max_bytes: int = _MAX_BYTES) -> int:
    """Size of a file. Raises FormatError unless it is a regular file (a device never ends) of at most `max_bytes`."""
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:  # ValueError: a NUL, or half a character, in the name
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise FormatError(str(path), "a readable file", reason.lower()) from error
    if stat.S_ISDIR(status.st_mode):
        raise FormatError(str(path), "a readable file", "is a directory")
    if not stat.S_ISREG(status.st_mode):
        raise FormatError(str(path), "a regular file", "a device, a pipe or a socket")
    if status.st_size > max_bytes:
        raise FormatError(str(path), f"at most {max_bytes:,} bytes", f"{status.st_size:,}")
    return status.st_size


def read_bytes(path: Path | str, max_bytes: int = _MAX_BYTES) -> bytes:
    """The bytes of a file. Raises FormatError as `check_regular_file`, and if it cannot be read.

    Makes as few system calls as possible: tens of thousands of small files are read at once.
    """
    size = check_regular_file(path, max_bytes)
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
        try:
            data = os.read(descriptor, size + 1)
            if len(data) != size:  # it changed meanwhile, or is longer than one call can read
                parts = [data]
                while parts[-1]:
                    parts.append(os.read(descriptor, _CHUNK_BYTES))
                data = b"".join(parts)
        finally:
            os.close(descriptor)
        return data
    except OSError as error:
        raise FormatError(str(path), "a readable file", (error.strerror or str(error)).lower()) from error


def read_text(path: Path | str, max_bytes: int = _MAX_BYTES) -> str:
    """The text of a UTF-8 file. Raises FormatError as `read_bytes`, and if it is no text."""
    return decode_utf8(read_bytes(path, max_bytes), path)


def read_gzip(path: Path, max_bytes: int = _MAX_BYTES) -> bytes:
    """The content of a gzip file. Raises FormatError as `read_bytes`, if it is none, or beyond `max_bytes`."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(read_bytes(path, max_bytes))) as stream:
            data = stream.read(max_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise FormatError(str(path), "a gzip file", error) from error
    if len(data) > max_bytes:
        raise FormatError(str(path), f"at most {max_bytes:,} bytes, unpacked", "more")
    return data


def decode_utf8(data: bytes, path: Path | str) -> str:
    """UTF-8 text without a byte-order mark. Raises FormatError naming the file if it is none."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(
            str(path), "UTF-8 text", f"byte 0x{error.object[error.start]:02x} at {error.start}"
        ) from error


def read_json(path: Path) -> Any:
    """The value in a JSON file. Raises FormatError with line and column.

    Deep nesting, integers beyond 64 bits, NUL and unpaired surrogates are rejected too.
    """
    return parse_json(read_text(path), str(path))


def parse_json(text: str, where: str, object_hook: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """The value of JSON text from the file `where`. Raises FormatError as `read_json`.

    `object_hook` replaces each object by what it returns.
    """
    try:
        parse_int = _parse_integer if _has_long_numbers(text) else None
        value = json.loads(text, parse_int=parse_int, object_hook=object_hook)
        if _INVALID_ESCAPE.search(text):
            _check_texts(value if object_hook is None else json.loads(text))
    except json.JSONDecodeError as error:
        raise FormatError(f"{where}:{error.lineno}:{error.colno}", "JSON", error.msg) from error
    except UnicodeEncodeError as error:
        raise FormatError(
            where, "text in whole characters", f"half of one, {error.object[error.start]!r}"
        ) from error
    except ValueError as error:
        raise FormatError(where, "JSON", error) from error
    except RecursionError as error:
        raise FormatError(where, "JSON", "lists or objects that are nested too deep") from error
    return value


def iterate_json_list(path: Path, start: re.Pattern[str]) -> Iterator[Any]:
    """Yield the items of a JSON list in a file one by one, since all at once need several times its bytes.

    Args:
        path: The file, of at most 8 GiB.
        start: Matches the text before the first item.

    Raises:
        FormatError: As `read_json`, naming the item; there is no such list.
    """
    check_regular_file(path, _MAX_LIST_BYTES)
    decoder, scan = codecs.getincrementaldecoder("utf-8-sig")(), json.JSONDecoder().raw_decode
    with path.open("rb") as stream:
        text = _decode_chunk(decoder, stream.read(_CHUNK_BYTES), path)
        match = start.match(text)
        if match is None:
            raise FormatError(str(path), "a list", repr(text[:40]))
        place, number = match.end(), 0
        while True:
            try:
                place = _skip_space(text, place)
                if text[place] == "]":
                    return
                if number and text[place] != ",":
                    raise FormatError(f"{path}[{number}]", "a comma or the end of the list", repr(text[place]))
                begin = _skip_space(text, place + 1) if number else place
                value, end = scan(text, begin)
                _ = text[end]  # a number may continue in the next chunk
            except (IndexError, json.JSONDecodeError, RecursionError) as error:
                more = _decode_chunk(decoder, stream.read(max(_CHUNK_BYTES, len(text) - place)), path)
                if not more:
                    found = "the end of the file" if isinstance(error, IndexError) else error
                    raise FormatError(f"{path}[{number}]", "JSON", found) from error
                text, place = text[place:] + more, 0
                continue
            item = text[begin:end]
            if _has_long_numbers(item) or _INVALID_ESCAPE.search(item):
                value = parse_json(item, f"{path}[{number}]")
            yield value
            place, number = end, number + 1


def _decode_chunk(decoder: codecs.IncrementalDecoder, data: bytes, path: Path) -> str:
    try:
        return decoder.decode(data, not data)
    except UnicodeDecodeError as error:
        raise FormatError(str(path), "UTF-8 text", f"byte 0x{error.object[error.start]:02x}") from error


def _skip_space(text: str, place: int) -> int:
    while text[place] in " \t\r\n":
        place += 1
    return place


def _has_long_numbers(text: str) -> bool:
    """Whether the text has as many digits in a row as an integer beyond 64 bits.

    Only then is each integer checked, which takes as long as the rest of the parsing.
    """
    for start in range(0, len(text), _CHUNK_BYTES):
        part = text[start : start + _CHUNK_BYTES + _INTEGER_DIGITS]
        digits = np.frombuffer(part.encode("utf-8", "surrogatepass"), np.uint8) - np.uint8(ord("0")) < 10
        run = 1
        while run < _INTEGER_DIGITS and digits.size:
            step = min(run, _INTEGER_DIGITS - run)
            digits = digits[:-step] & digits[step:]
            run += step
        if digits.any():
            return True
    return False


def _parse_integer(text: str) -> int:
    if len(text) > len(str(_INTEGER_LIMIT)) + 1 or abs(int(text)) >= _INTEGER_LIMIT:
        raise ValueError(f"an integer of {len(text)} digits, too large for 64 bits")
    return int(text)


def _check_texts(value: Any) -> None:
    """Raise ValueError for texts or keys with NUL or an unpaired surrogate."""
    written = json.dumps(value, ensure_ascii=False)
    written.encode("utf-8")
    if "\\u0000" in written:
        raise ValueError("text with a NUL character")


class _SafeYamlLoader(yaml.SafeLoader):
    """YAML without aliases, a few of which expand to gigabytes, and with integers of at most 64 bits."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.MarkedYAMLError(problem=f"an alias (*{event.anchor})", problem_mark=event.start_mark)
        return super().compose_node(parent, index)

    def integer(self, node: Any) -> int:
        """The integer of a node."""
        if len(node.value) > _MAX_YAML_DIGITS:
            raise ValueError(f"an integer of {len(node.value)} digits, too large for 64 bits")
        return _parse_integer(str(self.construct_yaml_int(node)))


_SafeYamlLoader.add_constructor("tag:yaml.org,2002:int", _SafeYamlLoader.integer)


def read_yaml(path: Path) -> Any:
    """The value in a YAML file. Raises FormatError if it is none, or has aliases, deep nesting or huge
    integers.
    """
    text = read_text(path, _MAX_YAML_BYTES)
    try:
        return yaml.load(text, _SafeYamlLoader)  # a subclass of SafeLoader
    except RecursionError as error:
        raise FormatError(str(path), "YAML", "lists or mappings that are nested too deep") from error
    except (yaml.YAMLError, ValueError, AttributeError, TypeError) as error:
        raise FormatError(str(path), "YAML", " ".join(str(error).split())) from error


@contextmanager
def open_image(path: Path, data: bytes | None = None) -> Iterator[Image]:
    """Open an image file with Pillow, which reads only its header at first.

    `data` is the content if known. Raises FormatError for no image, one beyond the size limit, and errors of
    Pillow inside the block.
    """
    from PIL import Image

    if data is None:
        check_regular_file(path)
    try:
        with (
            warnings.catch_warnings(action="ignore"),
            Image.open(path if data is None else io.BytesIO(data)) as image,
        ):
            width, height = image.size
            if width * height > _MAX_PIXELS:
                raise FormatError(str(path), f"an image of at most {_MAX_PIXELS:,} px", f"{width}x{height}")
            yield image
    except FormatError:
        raise
    except Image.DecompressionBombError as error:
        raise FormatError(str(path), f"an image of at most {_MAX_PIXELS:,} px", "one of more") from error
    # readers of damaged headers, such as EXIF, raise many types
    except (OSError, ValueError, SyntaxError, ArithmeticError, LookupError, TypeError, struct.error) as error:
        found = f"{path.stat().st_size if data is None else len(data)} bytes that do not decode"
        raise FormatError(str(path), "an image", found) from error


def read_image_size(path: Path, data: bytes) -> tuple[int, int]:
    """Width and height in an image's header. Raises FormatError as `open_image`."""
    with open_image(path, data) as image:
        return image.size


def check_utf8(field: str, text: str) -> None:
    """Raise FormatError naming the field for text that is invalid in UTF-8, such as some old file names."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise FormatError(field, "text that UTF-8 holds", ascii(text)) from error


def _is_whole(data: bytes) -> bool:
    """Whether a PNG or JPEG has its end marker; True for other formats.

    Phones append data after it. OpenCV silently fills missing rows with grey.
    """
    if data.startswith(b"\x89PNG"):
        place = 8
        while place + 12 <= len(data):
            if data[place + 4 : place + 8] == b"IEND":
                return True
            place += 12 + int.from_bytes(data[place : place + 4], "big")
        return False
    if data.startswith(b"\xff\xd8"):
        place = 2
        while place + 4 <= len(data) and data[place] == 0xFF:
            if data[place + 1] == 0xDA:  # the picture itself, in which 0xFF stands before no other marker
                return data.find(b"\xff\xd9", place) >= 0
            filler = data[place + 1] == 0xFF
            place += 1 if filler else 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        return b"\xff\xd9" in data[-64:]
    return True


def _decode(path: Path) -> np.ndarray:
    """The values of an image file, unchanged, by OpenCV. Raises FormatError if it is missing or no image."""
    import cv2

    data = read_bytes(path)
    read_image_size(path, data)
    image = None
    if data and _is_whole(data):
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            raise FormatError(str(path), "an image", f"what does not decode ({error.err})") from error
    if image is None:
        raise FormatError(str(path), "an image", f"{len(data)} bytes that do not decode")
    return image


def _check_size(path: Path, image: np.ndarray, size_hw: tuple[int, int] | None) -> None:
    if size_hw is not None and image.shape[:2] != size_hw:
        raise FormatError(str(path), f"{size_hw[1]}x{size_hw[0]} px", f"{image.shape[1]}x{image.shape[0]} px")


def read_image(path: Path, size_hw: tuple[int, int] | None = None) -> np.ndarray:
    """An 8-bit colour image as (H, W, 3) RGB uint8.

    Raises FormatError if the file is missing, truncated, no image, not 8-bit with three channels, or not of
    `size_hw`.
    """
    image = _decode(path)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        channels = image.shape[2] if image.ndim == 3 else 1
        raise FormatError(str(path), "8 bits and 3 channels", f"{image.dtype.itemsize * 8} bits and {channels}")
    _check_size(path, image, size_hw)
    return np.ascontiguousarray(image[..., ::-1])


def read_uint16(path: Path, size_hw: tuple[int, int] | None = None) -> np.ndarray:
    """A 16-bit image of one channel as (H, W) uint16. Raises FormatError as `read_image`."""
    image = _decode(path)
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = image.shape[2] if image.ndim == 3 else 1
        raise FormatError(str(path), "16 bits and 1 channel", f"{image.dtype.itemsize * 8} bits and {channels}")
    _check_size(path, image, size_hw)
    return image


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an NPZ. Raises FormatError if it is none, has pickled objects, or arrays of a wrong size."""
    data = read_bytes(path)
    if data.startswith(np.lib.format.MAGIC_PREFIX):
        raise FormatError(str(path), "an NPZ archive of arrays", "a single array")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            total = sum(member.file_size for member in archive.infolist())
            if total > _MAX_BYTES:
                raise FormatError(str(path), f"arrays of at most {_MAX_BYTES:,} bytes", f"{total:,}")
            return {
                member.filename.removesuffix(".npy"): _parse_npy(_read_member(archive, member))
                for member in archive.infolist()
            }
    except FormatError:
        raise
    # zipfile raises RuntimeError and its subclasses for a missing password or an unknown compression
    except (
        *(zipfile.BadZipFile, zlib.error, struct.error, ValueError, EOFError, OSError, RuntimeError),
        *(tokenize.TokenError, SyntaxError, TypeError, OverflowError),  # from a header, which is Python text
    ) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise FormatError(str(path), "an NPZ archive of arrays", reason) from error


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytearray:
    """The bytes of a member, at most as many as the archive lists."""
    with archive.open(member) as stream:
        data = bytearray(stream.read(member.file_size))
        stream.read(1)  # to the end, so that the checksum is verified
    return data


def _parse_npy(data: bytearray) -> np.ndarray:
    """The array of an NPY file, in the same memory. Raises ValueError if it is none, or of another size."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in read_header:
        raise ValueError(f"an array of version {version}")
    shape, columns_first, dtype = read_header[version](stream)
    if dtype.hasobject:
        raise ValueError("objects, which are pickles (allow_pickle is off)")
    offset = stream.seek(0, io.SEEK_CUR)
    size = len(data) - offset
    if dtype.itemsize * math.prod(shape) != size or min(shape, default=0) < 0:
        raise ValueError(f"an array of shape {shape} and {dtype} in {size} bytes")
    flat = np.frombuffer(data, dtype, math.prod(shape), offset)
    return flat.reshape(shape, order="F" if columns_first else "C")
