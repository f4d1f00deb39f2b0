"""Damaged versions of good files, as hypothesis strategies."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib

from hypothesis import strategies as st

# Numbers at the borders of integer types, and words that parsers take for numbers.
_BORDERS = [0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF]
_WORDS = [b"nan", b"-inf", b"1e308", b"1e999", b"-1", b"0", b"", b"9" * 400, b"1_0", b"0x1F", b"\xd9\xa3", b"\x00"]
_WORDS += [b"null", b"[[", b"{", b"&a [*a]", b"!!python/object:os.system", b"..", b"-0.0", b"1e-320", b"99999999999"]


@st.composite
def mutated(draw: st.DrawFn, samples: tuple[bytes, ...]) -> bytes:
    """One of the samples with one to eight changes, or bytes that have nothing to do with it."""
    data = bytearray(draw(st.sampled_from(samples)))
    if draw(st.integers(0, 15)) == 0:
        return draw(st.binary(max_size=512))
    for _ in range(draw(st.integers(1, 8))):
        start = draw(st.integers(0, len(data)))
        kind = draw(st.sampled_from(("bytes", "border", "word", "cut", "end", "double", "bit")))
        if kind == "bytes":
            piece = draw(st.binary(min_size=1, max_size=8))
            data[start : start + len(piece)] = piece
        elif kind == "border":
            order = draw(st.sampled_from("<>"))
            data[start : start + 4] = struct.pack(f"{order}I", draw(st.sampled_from(_BORDERS)))
        elif kind == "word":
            _replace_word(data, start, draw(st.sampled_from(_WORDS)))
        elif kind == "cut":
            del data[start : start + draw(st.integers(1, 64))]
        elif kind == "end":
            del data[start:]
        elif kind == "double":
            data[start:start] = data[start : start + draw(st.integers(1, 256))]
        elif start < len(data):
            data[start] ^= 1 << draw(st.integers(0, 7))
    return bytes(data)


@st.composite
def zipped(draw: st.DrawFn, samples: tuple[dict[str, bytes], ...]) -> bytes:
    """Zip files with right checksums around entries of which one is damaged; now and then the zip itself is, too."""
    entries = dict(draw(st.sampled_from(samples)))
    name = draw(st.sampled_from(sorted(entries)))
    entries[name] = draw(mutated((entries[name],)))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", draw(st.sampled_from((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))) as archive:
        for entry, data in entries.items():
            archive.writestr(entry, data)
    return draw(mutated((stream.getvalue(),))) if draw(st.integers(0, 3)) == 0 else stream.getvalue()


def _replace_word(data: bytearray, start: int, word: bytes) -> None:
    """Puts `word` in the place of the blank-separated word at or behind `start`."""
    while start < len(data) and data[start : start + 1].isspace():
        start += 1
    end = start
    while end < len(data) and not data[end : end + 1].isspace():
        end += 1
    data[start:end] = word


@st.composite
def png_files(draw: st.DrawFn) -> bytes:
    """PNG files whose checksums are right and whose headers and streams are anything."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    size = st.one_of(st.integers(0, 40), st.sampled_from(_BORDERS))
    kinds = (draw(st.sampled_from((1, 2, 4, 8, 16, 17))), draw(st.sampled_from((0, 2, 3, 4, 6, 1))))
    header = struct.pack(">IIBBBBB", draw(size), draw(size), *kinds, 0, 0, draw(st.integers(0, 2)))
    pixels = zlib.compress(draw(st.binary(max_size=200)) * draw(st.integers(1, 40)))
    extra = chunk(draw(st.sampled_from((b"PLTE", b"tRNS", b"gAMA", b"iCCP", b"eXIf"))), draw(st.binary(max_size=40)))
    parts = [chunk(b"IHDR", header), extra if draw(st.booleans()) else b"", chunk(b"IDAT", pixels), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


_PIECES = [bytes([code]) for code in b".0()tl]}d\x85\x86\x87aesu2b\x81R1N\x88\x89\x8f\x90\x91\x93\x94IJKMUVXcGh"]
_PIECES += [b"cnumpy\ndtype\n", b"cnumpy\nndarray\n", b"cnumpy.core.multiarray\n_reconstruct\n"]
_PIECES += [b"cnumpy.core.multiarray\nscalar\n", b"cnumpy.core.numeric\n_frombuffer\n", b"c_codecs\nencode\n"]
_PIECES += [b"(U\x02f8K\x00K\x01tR", b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb", b"(K\x00tU\x01b\x87R"]
_PIECES += [b"q\x00", b"q\x01", b"h\x00", b"h\x01", b"K\x01", b"K\x02\x85", b"K\x3f", b"J\x00\x00\x00\x80"]
_PIECES += [b"C\x08AAAAAAAA", b"U\x01C", b"U\x02O8", b"U\x02S8", b"U\x02U2"]


def opcodes() -> st.SearchStrategy[bytes]:
    """Pickles put together from opcodes and from pieces of arrays, in any order."""
    return st.lists(st.sampled_from(_PIECES), max_size=40).map(lambda pieces: b"".join(pieces) + b".")
