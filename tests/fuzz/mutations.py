"""What becomes of a valid input: bytes, JSON, text, command lines and tensors with some of it changed.

All take a seeded `random.Random` first, which alone decides what is done. That, and no search such as
hypothesis has: a case is then a number, the same whatever ran before it, also after a case that killed the
process it ran in.
"""

from __future__ import annotations

import copy
import json
import math
import re
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import torch
from torch import Tensor

CANARY = "fuzz_canary"  # a module in the working folder, which no file may have imported
DEEP = 20_000  # levels of nesting: beyond any recursion limit
LONG = 100_000  # characters

NUMBERS = (
    *(0, 1, -1, 2, 7, 255, 256, 2**31 - 1, 2**31, -(2**31), 2**53, 2**62, 2**63, 2**64, 10**12, 10**30),
    *(0.5, -0.0, 1e-300, 1e300, math.nan, math.inf, -math.inf),
)
CLASSES = (
    *(f"{CANARY}.Module", f"{CANARY}.run", "os.system", "dejavu_torch.cli.__main__.main", "builtins.exec"),
    *("HOG", "Whitening", "SmallCNN", "SpectralMapper", "TemplateMapper", "torch.nn.Identity", "nn.Linear"),
)
TEXTS = (
    *(
        "",
        " ",
        "x",
        "none",
        "null",
        "true",
        "NaN",
        "é",
        "日本",
        "\n",
        "a\nb",
        "\r\n",
        "\0",
        "\x1b[31m",
        "\u2028",
    ),
    *("%s", "%n", "../..", ".", "..", "~", "a" * 300, "a" * LONG, "1" * 5000, "-", "--", "\udcff", "\ufeff"),
)
TOKENS = (  # of text files and options, where numbers stand as text
    *map(str, NUMBERS),
    *("1e999", "-1e-999", "0x10", "1_000", "١٢", "1.5", "+3", " 4", "1,2", '"', "'", "[", "]", "{", "}"),
    *(":", ",", ";", "=", "?", "&", "#", "@", "*", "|", ">", "\t", "- ", "---", "...", "<<: *a", "&a [*a]"),
    *TEXTS,
)
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(  # aliases of aliases: 9 ** 9 texts
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
TAGS = (
    f"!!python/object/apply:{CANARY}.run []",
    f"!!python/object/new:{CANARY}.Module []",
    f"!!python/name:{CANARY}.run",
    f"!!python/module:{CANARY}",
    *("!!binary x", "!!set {a}", "!!timestamp 2001-01-01", "!!int x", "!unknown x", "!!float .inf"),
)
PICKLES = (  # each calls the canary where it is unpickled
    f"c{CANARY}\nrun\n(tR.".encode(),
    b"\x80\x02" + f"c{CANARY}\nrun\n)R.".encode(),
    f"(S'{CANARY}'\ni{CANARY}\nrun\n.".encode(),
)
ONE_EACH = 0.7  # of the cases have a single change: several hide each other


def times(random: Random) -> int:
    """How many changes."""
    return 1 if random.random() < ONE_EACH else random.randint(2, 5)


def mutate_bytes(random: Random, data: bytes) -> bytes:
    """Bytes flipped, cut, doubled, spliced, overwritten or inserted; mostly near an end."""
    for _ in range(times(random)):
        data = random.choice(BYTES)(random, data)
    return data


def _place(random: Random, data: bytes) -> int:
    """Somewhere in the bytes."""
    near = min(len(data), random.choice((16, 256, 4096, len(data))))
    at = random.randrange(near + 1)
    return max(0, len(data) - 1 - at) if random.random() < 0.3 else min(at, max(0, len(data) - 1))


def _piece(random: Random, data: bytes) -> tuple[int, int]:
    at = _place(random, data)
    return at, min(len(data), at + random.choice((1, 2, 4, 8, 64, 1024)))


def _flip(random: Random, data: bytes) -> bytes:
    if not data:
        return data
    changed, at = bytearray(data), _place(random, data)
    changed[at] ^= 1 << random.randrange(8)
    return bytes(changed)


def _overwrite(random: Random, data: bytes) -> bytes:
    start, stop = _piece(random, data)
    filled = random.choice((b"\0", b"\xff", b"\x7f", b"\x80", b" ", b"9")) * (stop - start)
    return data[:start] + filled + data[stop:]


def _noise(random: Random, data: bytes) -> bytes:
    start, stop = _piece(random, data)
    return data[:start] + random.randbytes(stop - start) + data[stop:]


def _truncate(random: Random, data: bytes) -> bytes:
    return data[: _place(random, data)]


def _double(random: Random, data: bytes) -> bytes:
    return data + data


def _splice(random: Random, data: bytes) -> bytes:
    (start, stop), at = _piece(random, data), _place(random, data)
    return data[:at] + data[start:stop] + data[at:]


def _insert(random: Random, data: bytes) -> bytes:
    at = _place(random, data)
    return data[:at] + random.randbytes(random.choice((1, 3, 8, 500))) + data[at:]


def _delete(random: Random, data: bytes) -> bytes:
    start, stop = _piece(random, data)
    return data[:start] + data[stop:]


def _replace_all(random: Random, data: bytes) -> bytes:
    return random.choice((b"", b"\0" * 100, random.randbytes(1000), *PICKLES))


BYTES = (_flip, _flip, _flip, _overwrite, _noise, _truncate, _double, _splice, _insert, _delete, _replace_all)


def mutate_json(random: Random, value: Any) -> Any:
    """A tree of JSON values with some replaced by another type or size, removed, renamed or added."""
    value = copy.deepcopy(value)
    for _ in range(times(random)):
        value = _mutate_node(random, value)
    return value


def _mutate_node(random: Random, value: Any) -> Any:
    places = list(_places(value))
    if not places:
        return odd_value(random, value)
    holder, key = random.choice(places)
    act = random.random()
    if act < 0.75:
        holder[key] = odd_value(random, holder[key])
    elif act < 0.85:
        del holder[key]
    elif isinstance(holder, dict):
        holder[random.choice((*TEXTS[:20], "class_path", "init_args", str(key) + "_"))] = holder[key]
    else:
        holder.insert(key, odd_value(random, holder[key]))
    return value


def _places(value: Any) -> Any:
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
        yield value, key
        if isinstance(inner, (dict, list)):
            yield from _places(inner)


def odd_value(random: Random, value: Any) -> Any:
    """Something else in place of a JSON value."""
    act = random.random()
    if isinstance(value, bool) or value is None:
        act += 0.25
    if act < 0.25 and isinstance(value, int | float):
        return random.choice(
            (value + 1, value - 1, -value, value * 2, value * 1000, float(value), str(value))
        )
    if act < 0.25 and isinstance(value, str):
        return random.choice((value + value, value[:-1], value + "\n", *CLASSES))
    if act < 0.25 and isinstance(value, list):
        return random.choice((value + value, value[:-1], value[::-1], [value], value * 1000))
    kind = random.randrange(8)
    if kind < 4:
        return random.choice(NUMBERS)
    if kind == 4:
        return random.choice(TEXTS)
    if kind == 5:
        return random.choice(
            (None, True, False, [], {}, [None], [[1, 2]], [-1, 2**62], [1e300] * 3, [0] * 10_000)
        )
    if kind == 6:
        return {"class_path": random.choice(CLASSES), "init_args": random.choice(({}, {"a": 1}, None, []))}
    return random.choice((Nested("["), Nested("{")))


class Nested(str):
    """Stands in a tree for brackets that nest deeply, which no list could be written as."""

    __slots__ = ()

    def __deepcopy__(self, memo: Any) -> Nested:
        return self


def json_text(value: Any) -> str:
    """A tree as JSON, NaN and infinities as Python writes them."""

    def plain(value: Any) -> Any:
        if isinstance(value, Nested):
            return f"@{value}@"
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        return [plain(inner) for inner in value] if isinstance(value, list) else value

    return (
        json.dumps(plain(value))
        .replace('"@[@"', "[" * DEEP + "]" * DEEP)
        .replace('"@{@"', '{"a":' * DEEP + "0" + "}" * DEEP)
    )


def mutate_text(random: Random, text: str, tokens: Sequence[str] = TOKENS) -> bytes:
    """A text with other tokens or lines, sometimes no UTF-8 at all."""
    for _ in range(times(random)):
        by_line = random.random() < 0.2
        parts = text.splitlines(keepends=True) if by_line else re.split(r"(\s+|[,:=?&@\[\]{}])", text)
        if not parts:
            return random.choice(tokens).encode(errors="surrogateescape")
        at, act = random.randrange(len(parts)), random.randrange(7)
        if act < 3:
            parts[at] = random.choice(tokens)
        elif act == 3:
            del parts[at]
        elif act == 4:
            parts.insert(at, random.choice(tokens))
        elif act == 5:
            parts[at] *= random.choice((2, 50, 5000)) if len(parts[at]) < 100 else 2
        else:
            other = random.randrange(len(parts))
            parts[at], parts[other] = parts[other], parts[at]
        text = "".join(parts)
    data = text.encode(errors="surrogatepass")
    if random.random() < 0.1:
        return mutate_bytes(random, data)
    return text.encode(random.choice(("utf-16", "latin-1")), "replace") if random.random() < 0.05 else data


def mutate_words(random: Random, words: Sequence[str], others: Sequence[Sequence[str]]) -> list[str]:
    """A command line with words removed, doubled, exchanged, emptied, changed, or some of other lines.

    Args:
        others: words that stand together, such as an option and its value.

    No word becomes an absolute path: what a command writes stays in its folder.
    """
    found = list(words)
    for _ in range(times(random)):
        at, act = random.randrange(len(found)) if found else 0, random.randrange(12)
        if not found or act < 3:
            found += random.choice(others)
        elif act == 3:
            del found[at]
        elif act == 4:
            found.insert(at, found[at])
        elif act == 5:
            other = random.randrange(len(found))
            found[at], found[other] = found[other], found[at]
        elif act == 6:
            found[at : at + 1] = random.choice(others)
        else:
            values = [i for i, word in enumerate(found) if (i and not word.startswith("--")) or "=" in word]
            at = random.choice(values) if values and random.random() < 0.7 else at
            name, equals, value = found[at].partition("=")
            name, value = (name + equals, value) if name.startswith("--") and equals else ("", found[at])
            if random.random() < 0.5:
                found[at] = name + random.choice(TOKENS)
            else:
                found[at] = name + mutate_text(random, value).decode(errors="surrogateescape")
    # a system hands over no word with a zero byte; the others begin at the root of its files, or at home
    return [re.sub("(^|=|:)(/|~)+", r"\1", word.replace("\0", "")) for word in found]


def mutate_tensors(random: Random, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of other values, shapes, types or names, some left out."""
    found = dict(tensors)
    for _ in range(times(random)):
        if not found:
            break
        name = random.choice(sorted(found))
        act = random.randrange(12)
        if act == 0:
            del found[name]
        elif act == 1:
            found[name + random.choice(("", "_", ".weight"))] = found.pop(name)
        elif act == 2:
            found[random.choice(("map.extra", "features.x", "whitening.y", "z", ""))] = found[name]
        elif act == 3:
            other = random.choice(sorted(found))
            found[name], found[other] = found[other], found[name]
        else:
            found[name] = random.choice(TENSORS)(random, found[name])
    return found


def _reshaped(random: Random, tensor: Tensor) -> Tensor:
    shapes = (tensor[None], tensor.flatten(), tensor[..., None], tensor.flatten()[:0], tensor.new_zeros(()))
    return random.choice(shapes)


def _resized(random: Random, tensor: Tensor) -> Tensor:
    if not tensor.ndim:
        return tensor[None].expand(3)
    return random.choice(
        (tensor[:-1], torch.cat([tensor, tensor]), tensor[:1], tensor[..., :1], tensor.flip(0))
    )


def _retyped(random: Random, tensor: Tensor) -> Tensor:
    kinds = (torch.float64, torch.float16, torch.int64, torch.int8, torch.uint8, torch.bool, torch.int32)
    return tensor.to(random.choice((*kinds, torch.bfloat16, torch.float32)))


def _filled(random: Random, tensor: Tensor) -> Tensor:
    value = random.choice(
        (0, 1, -1, 127, 255, 2**31 - 1, 2**62, -(2**62), math.nan, math.inf, -math.inf, 1e30)
    )
    tensor = tensor.clone()
    if not tensor.is_floating_point():
        limits = (
            (0, 1)
            if tensor.dtype == torch.bool
            else (torch.iinfo(tensor.dtype).min, torch.iinfo(tensor.dtype).max)
        )
        value = min(max(int(value) if math.isfinite(value) else -1, limits[0]), limits[1])
    filling = torch.tensor(value).to(tensor.dtype)  # inf where halves hold no such number
    if tensor.numel() and random.random() < 0.6:
        tensor.view(-1)[random.randrange(tensor.numel())] = filling
        return tensor
    return tensor.copy_(filling)


def _shuffled(random: Random, tensor: Tensor) -> Tensor:
    data = (
        bytearray(tensor.contiguous().view(-1).view(torch.uint8).numpy().tobytes()) if tensor.numel() else b""
    )
    if not data:
        return tensor
    for _ in range(random.choice((1, 10, 100))):
        data[random.randrange(len(data))] = random.randrange(256)
    return torch.frombuffer(data, dtype=torch.uint8).view(tensor.dtype).view(tensor.shape).clone()


TENSORS: tuple[Callable[[Random, Tensor], Tensor], ...] = (
    *(_reshaped, _resized, _retyped, _filled, _filled, _shuffled),
)
