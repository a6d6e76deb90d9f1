"""What becomes of a valid input: bytes and text with some of it changed.

All take a seeded `random.Random` first, which alone decides what is done. That, and no search such as
hypothesis has: a case is then a number, the same whatever ran before it, also after a case that killed the
process it ran in.
"""

from __future__ import annotations

import math
import re

LONG = 100_000  # characters

NUMBERS = (
    *(0, 1, -1, 2, 7, 255, 256, 2**31 - 1, 2**31, -(2**31), 2**53, 2**62, 2**63, 2**64, 10**12, 10**30),
    *(0.5, -0.0, 1e-300, 1e300, math.nan, math.inf, -math.inf),
)
TEXTS = (
    *("", " ", "x", "none", "null", "true", "NaN", "é", "日本", "\n", "a\nb", "\r\n", "\0", "\x1b[31m"),
    *("\u2028", "%s", "%n", "../..", ".", "..", "~", "a" * 300, "a" * LONG, "1" * 5000, "-", "--", "\udcff"),
    "\ufeff",
)
TOKENS = (  # of text files and options, where numbers stand as text
    *map(str, NUMBERS),
    *("1e999", "-1e-999", "0x10", "1_000", "١٢", "1.5", "+3", " 4", "1,2", '"', "'", "[", "]", "{", "}"),
    *(":", ",", ";", "=", "?", "&", "#", "@", "*", "|", ">", "\t", "- ", "---", "...", "<<: *a", "&a [*a]"),
    *TEXTS,
)
ONE_EACH = 0.7  # of the cases have a single change: several hide each other


def times(random):
    """How many changes."""
    return 1 if random.random() < ONE_EACH else random.randint(2, 5)


def mutate_bytes(random, data):
    """Bytes flipped, cut, doubled, spliced, overwritten or inserted; mostly near an end."""
    for _ in range(times(random)):
        start, other = _place(random, data), _place(random, data)
        stop = min(len(data), start + random.choice((1, 2, 4, 8, 64, 1024)))
        size = random.choice((1, 3, 8, 500))
        flipped = bytes([data[start] ^ 1 << random.randrange(8)]) if data else b""
        filled = random.choice((b"\0", b"\xff", b"\x7f", b"\x80", b" ", b"9")) * (stop - start)
        changed = (
            *[data[:start] + flipped + data[start + 1 :]] * 3,
            data[:start] + filled + data[stop:],
            data[:start] + random.randbytes(stop - start) + data[stop:],
            data[:start],
            data + data,
            data[:other] + data[start:stop] + data[other:],
            data[:start] + random.randbytes(size) + data[start:],
            data[:start] + data[stop:],
            random.choice((b"", b"\0" * 100, random.randbytes(1000))),
        )
        data = random.choice(changed)
    return data


def _place(random, data):
    """Somewhere in the bytes."""
    near = min(len(data), random.choice((16, 256, 4096, len(data))))
    at = random.randrange(near + 1)
    return max(0, len(data) - 1 - at) if random.random() < 0.3 else min(at, max(0, len(data) - 1))


def mutate_text(random, text):
    """A text with other tokens or lines, sometimes no UTF-8 at all."""
    for _ in range(times(random)):
        by_line = random.random() < 0.2
        parts = text.splitlines(keepends=True) if by_line else re.split(r"(\s+|[,:=?&@\[\]{}])", text)
        if not parts:
            return random.choice(TOKENS).encode(errors="surrogateescape")
        at, act = random.randrange(len(parts)), random.randrange(7)
        if act < 3:
            parts[at] = random.choice(TOKENS)
        elif act == 3:
            del parts[at]
        elif act == 4:
            parts.insert(at, random.choice(TOKENS))
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
