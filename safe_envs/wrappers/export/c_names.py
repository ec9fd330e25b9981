"""Names of C for what users have named."""

from __future__ import annotations

import re
from collections.abc import Iterable

_WORDS = (
    "auto break case char const continue default do double else enum extern float for goto if"
    " inline int long register restrict return short signed sizeof static struct switch typedef"
    " union unsigned void volatile while _Bool _Complex _Imaginary bool true false complex"
    " alignas alignof atomic_bool constexpr noreturn nullptr static_assert thread_local typeof"
    # Of C++, so that its programs can read the header.
    " and and_eq asm bitand bitor catch class compl concept const_cast delete dynamic_cast"
    " explicit export friend module mutable namespace new not not_eq operator or or_eq private"
    " protected public reinterpret_cast requires static_cast template this throw try typeid"
    " typename using virtual wchar_t xor xor_eq"
    # Of the headers that are included, and of compilers' own.
    " acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2 expm1"
    " fabs fdim floor fma fmax fmin fmod frexp hypot ilogb ldexp lgamma log log10 log1p log2 logb"
    " modf nan nearbyint nextafter pow remainder remquo rint round scalbn signbit sin sinh sqrt"
    " tan tanh tgamma trunc isfinite isinf isnan j0 j1 jn y0 y1 yn gamma signgam linux unix near"
    " far main NAN INFINITY NULL"
)

KEYWORDS = frozenset(_WORDS.split())
"""Words that no variable may have for a name."""

OWN = frozenset(
    [
        "real",
        "vector",
        "table",
        "numbers",
        "data",
        "work",
        "larger",
        "smaller",
        "part",
        "found",
        "input",
        "result",
    ]
)
"""Words that the generated code uses itself."""

_LONGEST = 40


def c_name(text: str) -> str:
    """Return a name of C that resembles a text."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")[:_LONGEST] or "unnamed"
    name = f"n{name}" if name[0].isdigit() else name
    return f"{name}_" if name in KEYWORDS else name


def c_names(texts: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return names of C, all different, in the order of texts.

    Args:
        texts: names that users have given, any texts.
        taken: names that are not free.
    """
    used, found = set(taken), []
    for text in texts:
        stem = name = c_name(text)
        number = 2
        while name in used:
            name, number = f"{stem}_{number}", number + 1
        used.add(name)
        found.append(name)
    return found


def comment(text: str) -> str:
    """Return a text on one line that neither ends a comment nor begins one."""
    plain = "".join(c if " " <= c <= "~" else "?" for c in " ".join(text.split()))
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??/", "?? /").replace("\\", "/")
