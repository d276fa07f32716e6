"""What a caller sends is read strictly, and told what is wrong: expected X, got Y, did you mean Z.

`Input` is the base of such models, `complaints` the words for pydantic's errors about them.
"""

from __future__ import annotations

import difflib
import itertools
import numbers
import re
import reprlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

LARGEST = 1e30  # magnitude of a number; float32 ends at 3e38
MAX_COMPLAINTS = 20  # nobody mends more at a time, and an answer shall not be larger than its request
_MAX_NAME = 64  # characters of a field's name that are compared and told
_MAX_SENTENCE = 500


class Input(BaseModel):
    """Base of everything a caller sends: frozen, finite numbers, no unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _name_the_nearest_field(cls, data: Any) -> Any:
        given = data if isinstance(data, dict) else {}
        unknown = list(
            itertools.islice((name for name in given if name not in cls.model_fields), MAX_COMPLAINTS)
        )
        if not unknown:
            return data
        raise ValidationError.from_exception_data(
            cls.__name__,
            [
                InitErrorDetails(type=_unknown_field(n, cls.model_fields), loc=(n,), input=data[n])
                for n in unknown
            ],
        )


def _unknown_field(name: object, fields: Iterable[str]) -> PydanticCustomError:
    told = str(name)[:_MAX_NAME]
    near = difflib.get_close_matches(told, list(fields), n=1, cutoff=0.0)[0]
    return PydanticCustomError(
        "unknown_field",
        "unknown field '{name}'; did you mean '{near}'? (valid: {valid})",
        {"name": told, "near": near, "valid": ", ".join(fields)},
    )


def finite(value: Any) -> Any:
    """For pydantic's BeforeValidator: a number, neither NaN nor too large for float32; no bool, no text."""
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if is_number and abs(value) < LARGEST:
        return value
    raise ValueError(f"expected a finite number below {LARGEST:g}, got {short(value)}")


Number = Annotated[float, BeforeValidator(finite)]
Positive = Annotated[float, Field(gt=0.0), BeforeValidator(finite)]


# ---- what is wrong ----

UNION_TAGS = (
    "look_at",
    "matrix",
    "pytorch3d",
    "network",
)  # pydantic puts the chosen member into the location; it is no field
_QUOTED = re.compile(r"'([^']*)'")


def complaints(
    line_errors: Sequence[Mapping[str, Any]], under: Sequence[str | int] = ()
) -> Iterator[tuple[str, str]]:
    """A JSON pointer and a sentence for the first MAX_COMPLAINTS of pydantic's `error.errors()`.

    The last of them says how many there are beyond. `under` is where the validated value sits in the request.
    A location that begins with `body`, as FastAPI's do, loses it.
    """
    beyond = len(line_errors) - MAX_COMPLAINTS
    for number, line in enumerate(line_errors[:MAX_COMPLAINTS], 1):
        path = [*under, *line["loc"]]
        path = [str(step) for step in (path[1:] if path[:1] == ["body"] else path) if step not in UNION_TAGS]
        sentence = _sentence(line)[:_MAX_SENTENCE]
        if number == MAX_COMPLAINTS and beyond > 0:
            sentence += f" (and {beyond} further errors)"
        yield "".join("/" + _token(step) for step in path), sentence


def _token(step: str) -> str:
    """A step of a JSON pointer (RFC 6901)."""
    return step[:_MAX_NAME].replace("~", "~0").replace("/", "~1")


def in_one_line(wrong: Iterable[tuple[str, str]]) -> str:
    """All complaints as one text."""
    return "; ".join(f"{pointer or '/'}: {sentence}" for pointer, sentence in wrong)


def _sentence(line: Mapping[str, Any]) -> str:
    kind, message, given = line.get("type"), str(line["msg"]), line.get("input")
    context = line.get("ctx", {})
    match kind:
        case "missing":
            got = f"only {', '.join(map(str, given))}" if isinstance(given, dict) and given else "none"
            return f"expected this required field, got {got:.200}"
        case "json_invalid":
            return f"expected JSON, got {short(given)} ({context['error']})"
        case "dict_type" | "model_type" | "model_attributes_type":
            return f"expected an object, got {short(given)}"
        case "union_tag_not_found":
            tags = ", ".join(map(repr, UNION_TAGS))
            return f"expected {context['discriminator']} to be one of {tags}, got none"
        case "union_tag_invalid":
            tags, tag = context["expected_tags"], context["tag"]
            return (
                f"expected {context['discriminator']} to be one of {tags}, got {short(tag)}{_near(tag, tags)}"
            )
        case "literal_error" | "enum":
            return f"expected {context['expected']}, got {short(given)}{_near(given, context['expected'])}"
    if message.startswith("Input should be "):
        wanted = message.removeprefix("Input should be ")
        wanted = f"a number {wanted}" if wanted.startswith(("greater", "less")) else wanted
        return f"expected {wanted}, got {short(given)}"
    return message.removeprefix("Value error, ")


def _near(given: object, quoted: str) -> str:
    near = difflib.get_close_matches(str(given)[:100].lower(), _QUOTED.findall(quoted), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def short(value: object) -> str:
    """A value that came, for a message: short whatever it is."""
    try:
        return reprlib.repr(value)
    except ValueError:  # Python refuses to print an integer of thousands of digits
        return "an integer of thousands of digits"
