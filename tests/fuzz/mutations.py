"""What becomes of a valid input: bytes, JSON, text and command lines with some of it changed.

All take a seeded `random.Random` first, which alone decides what is done. That, and no search such as
hypothesis has: a case is then a number, the same whatever ran before it, also after a case that killed the
process it ran in.
"""

from __future__ import annotations

import copy
import math
import re

CANARY = "fuzz_canary"  # a module in the working folder, which no file may have imported
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
            random.choice((b"", b"\0" * 100, random.randbytes(1000), *PICKLES)),
        )
        data = random.choice(changed)
    return data


def _place(random, data):
    """Somewhere in the bytes."""
    near = min(len(data), random.choice((16, 256, 4096, len(data))))
    at = random.randrange(near + 1)
    return max(0, len(data) - 1 - at) if random.random() < 0.3 else min(at, max(0, len(data) - 1))


def mutate_json(random, value):
    """A tree of JSON values with some replaced by another type or size, removed, renamed or added."""
    value = copy.deepcopy(value)
    for _ in range(times(random)):
        places = list(_places(value))
        if not places:
            value = odd_value(random, value)
            continue
        (holder, key), act = random.choice(places), random.random()
        if act < 0.75:
            holder[key] = odd_value(random, holder[key])
        elif act < 0.85:
            del holder[key]
        elif isinstance(holder, dict):
            holder[random.choice((*TEXTS[:20], "class_path", "init_args", f"{key}_"))] = holder[key]
        else:
            holder.insert(key, odd_value(random, holder[key]))
    return value


def _places(value):
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
        yield value, key
        if isinstance(inner, (dict, list)):
            yield from _places(inner)


def odd_value(random, value):
    """Something else in place of a JSON value."""
    near = ()
    if isinstance(value, int | float) and not isinstance(value, bool):
        near = (value + 1, value - 1, -value, value * 2, value * 1000, float(value), str(value))
    elif isinstance(value, str):
        near = (value + value, value[:-1], value + "\n", *CLASSES)
    elif isinstance(value, list):
        near = (value + value, value[:-1], value[::-1], [value], value * 1000)
    if near and random.random() < 0.25:
        return random.choice(near)
    built = {"class_path": random.choice(CLASSES), "init_args": random.choice(({}, {"a": 1}, None, []))}
    plain = (None, True, False, [], {}, [None], [[1, 2]], [-1, 2**62], [1e300] * 3, [0] * 10_000)
    others = (random.choice(TEXTS), random.choice(plain), built)
    return random.choice((*[random.choice(NUMBERS)] * 4, *others))


def mutate_text(random, text, tokens=TOKENS):
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


def mutate_words(random, words, others):
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
