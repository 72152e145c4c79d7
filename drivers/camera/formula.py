"""GenApi's formulas: read from text, evaluated with the values of a camera's features.

Source: EMVA, GenICam Standard, section GenApi 2.1 (schema version 1.1), reimplemented from its description.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping

from drivers.errors import InstrumentError

Number = int | float
Variables = Mapping[str, Callable[[], Number]]

_TOKEN = re.compile(
    r"\s*(?:(?P<hex>0[xX][0-9a-fA-F]+)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_.]*)|(?P<op>\*\*|<<|>>|<=|>=|<>|&&|\|\||[-+*/%&|^~<>=?:(),]))"
)
_BINARY: dict[str, tuple[int, bool]] = {  # operator -> (binding power, right associative)
    "||": (2, False),
    "&&": (3, False),
    "|": (4, False),
    "^": (5, False),
    "&": (6, False),
    "=": (7, False),
    "<>": (7, False),
    "<": (8, False),
    ">": (8, False),
    "<=": (8, False),
    ">=": (8, False),
    "<<": (9, False),
    ">>": (9, False),
    "+": (10, False),
    "-": (10, False),
    "*": (11, False),
    "/": (11, False),
    "%": (11, False),
    "**": (13, True),
}
_UNARY_POWER = 12
_DEEPEST = 60
_MOST_TOKENS = 500


def _round_away(x: float, digits: int = 0) -> float:
    scale = 10.0**digits
    return math.copysign(math.floor(abs(x) * scale + 0.5) / scale, x)


_FUNCTIONS: dict[str, Callable[..., Number]] = {
    "SGN": lambda x: (x > 0) - (x < 0),
    "NEG": lambda x: -x,
    "ABS": abs,
    "SIN": math.sin,
    "COS": math.cos,
    "TAN": math.tan,
    "ASIN": math.asin,
    "ACOS": math.acos,
    "ATAN": math.atan,
    "EXP": math.exp,
    "LN": math.log,
    "LG": math.log10,
    "SQRT": math.sqrt,
    "TRUNC": math.trunc,
    "FLOOR": math.floor,
    "CEIL": math.ceil,
    "ROUND": lambda x, digits=0: _round_away(x, int(digits)),
    "E": lambda: math.e,
    "PI": lambda: math.pi,
}


def _divide(a: Number, b: Number) -> Number:
    """C's division: integers truncate towards zero."""
    if isinstance(a, int) and isinstance(b, int):
        quotient = abs(a) // abs(b)
        return quotient if (a < 0) == (b < 0) else -quotient
    return a / b


def _remainder(a: Number, b: Number) -> Number:
    return int(a) - int(b) * int(_divide(int(a), int(b)))


def _power(a: Number, b: Number) -> Number:
    """Integers stay integers while the result fits 64 bits; larger ones and negative powers are computed in floating
    point."""
    if isinstance(a, int) and isinstance(b, int) and b >= 0 and b * abs(a).bit_length() <= 128:
        return int(a**b)
    return math.pow(a, b)


def _shift(a: Number, by: Number) -> int:
    if not 0 <= int(by) < 64:
        raise ValueError(f"a shift by {by} bits is outside 0..63")
    return int(a) << int(by)


_APPLY: dict[str, Callable[[Number, Number], Number]] = {
    "|": lambda a, b: int(a) | int(b),
    "^": lambda a, b: int(a) ^ int(b),
    "&": lambda a, b: int(a) & int(b),
    "=": lambda a, b: int(a == b),
    "<>": lambda a, b: int(a != b),
    "<": lambda a, b: int(a < b),
    ">": lambda a, b: int(a > b),
    "<=": lambda a, b: int(a <= b),
    ">=": lambda a, b: int(a >= b),
    "<<": _shift,
    ">>": lambda a, b: int(a) >> int(b),
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": _divide,
    "%": _remainder,
    "**": _power,
}
_Evaluate = Callable[[Variables], Number]


class Formula:
    """A GenApi expression: C's operators, `**` for powers, `=` and `<>` to compare, `?:`, and the standard's functions.

    `Formula("(A & 0xFF) * 0.5")(variables)`; raises `ValueError` where the text isn't a formula, and `InstrumentError`
    where it can't be computed (a division by zero, an unknown variable).
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self._tokens: list[tuple[str, str]] = []
        at = 0
        stripped = text.rstrip()
        while at < len(stripped):
            match = _TOKEN.match(stripped, at)
            if match is None or match.lastgroup is None:
                raise ValueError(f"formula {text!r}: can't read {stripped[at : at + 10]!r}")
            self._tokens.append((match.lastgroup, match.group(match.lastgroup)))
            at = match.end()
        if len(self._tokens) > _MOST_TOKENS:
            raise ValueError(f"formula {text[:40]!r}... has more than {_MOST_TOKENS} parts")
        self._at = 0
        self._depth = 0
        self._evaluate = self._expression(0)
        if self._at != len(self._tokens):
            raise ValueError(f"formula {text!r}: {self._tokens[self._at][1]!r} is one too many")

    def __call__(self, variables: Variables) -> Number:
        """The value with `variables` (read when the formula needs them). Integers stay integers."""
        try:
            return self._evaluate(variables)
        except KeyError as error:
            raise InstrumentError(f"camera XML: formula {self.text!r} uses an unknown variable {error}") from error
        except (ArithmeticError, ValueError, TypeError) as error:
            raise InstrumentError(f"camera XML: formula {self.text!r} can't be computed: {error}") from error

    def _peek(self) -> str:
        return self._tokens[self._at][1] if self._at < len(self._tokens) else ""

    def _take(self, expected: str | None = None) -> tuple[str, str]:
        if self._at >= len(self._tokens) or (expected is not None and self._tokens[self._at][1] != expected):
            raise ValueError(f"formula {self.text!r}: {expected or 'a value'} is missing")
        self._at += 1
        return self._tokens[self._at - 1]

    def _expression(self, power: int) -> _Evaluate:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise ValueError(f"formula {self.text[:40]!r}... is nested more than {_DEEPEST} deep")
        left = self._prefix()
        while True:
            operator = self._peek()
            if operator == "?" and power <= 1:
                left = self._conditional(left)
            elif operator in _BINARY and _BINARY[operator][0] > power:
                binding, right_associative = _BINARY[operator]
                self._take()
                left = self._infix(operator, left, self._expression(binding - int(right_associative)))
            else:
                break
        self._depth -= 1
        return left

    def _conditional(self, condition: _Evaluate) -> _Evaluate:
        self._take("?")
        yes = self._expression(0)
        self._take(":")
        no = self._expression(0)
        return lambda v: yes(v) if condition(v) else no(v)

    @staticmethod
    def _infix(operator: str, left: _Evaluate, right: _Evaluate) -> _Evaluate:
        if operator == "&&":
            return lambda v: int(bool(left(v)) and bool(right(v)))
        if operator == "||":
            return lambda v: int(bool(left(v)) or bool(right(v)))
        apply = _APPLY[operator]
        return lambda v: apply(left(v), right(v))

    def _prefix(self) -> _Evaluate:
        kind, text = self._take()
        if text in ("-", "+", "~"):
            inner = self._expression(_UNARY_POWER)
            if text == "-":
                return lambda v: -inner(v)
            return inner if text == "+" else lambda v: ~int(inner(v))
        if text == "(":
            inner = self._expression(0)
            self._take(")")
            return inner
        if kind in ("hex", "number"):
            number: Number = (
                int(text, 16) if kind == "hex" else int(text) if re.fullmatch(r"\d+", text) else float(text)
            )
            return lambda v: number
        if kind == "name":
            return self._call(text) if self._peek() == "(" else lambda v: v[text]()
        raise ValueError(f"formula {self.text!r}: {text!r} stands where a value should")

    def _call(self, name: str) -> _Evaluate:
        function = _FUNCTIONS.get(name.upper())
        if function is None:
            raise ValueError(f"formula {self.text!r}: no function {name!r}")
        self._take("(")
        arguments: list[_Evaluate] = []
        while self._peek() != ")":
            arguments.append(self._expression(0))
            if self._peek() == ",":
                self._take()
        self._take(")")
        return lambda v: function(*(argument(v) for argument in arguments))
