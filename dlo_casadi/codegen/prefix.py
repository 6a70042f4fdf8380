"""The prefix of a generated library's names."""

from __future__ import annotations

import re

from dlo_casadi.errors import DloError

# Keywords of C99, C11 and C++, and what every program defines.
_KEYWORDS = """
auto break case char const continue default do double else enum extern float for
goto if inline int long register restrict return short signed sizeof static struct
switch typedef union unsigned void volatile while bool catch class constexpr
decltype delete dynamic_cast explicit export false friend mutable namespace new
noexcept nullptr operator private protected public reinterpret_cast static_assert
static_cast template this thread_local throw true try typeid typename using virtual
wchar_t and or not xor asm alignas alignof main errno
"""


def check_prefix(prefix: str) -> None:
    """Raise DloError unless the prefix can begin the names of a C library."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", prefix, flags=re.ASCII):
        raise DloError(
            f"the prefix {prefix!r} is not a C identifier: use letters, digits and underscores, "
            "a letter first, e.g. --prefix harness"
        )
    if prefix in _KEYWORDS.split():
        raise DloError(f"the prefix {prefix!r} is a keyword of C or C++; choose another one")
    if prefix.endswith("_") or len(prefix) > 40:
        raise DloError(f"the prefix {prefix!r} must be short and must not end in an underscore")
