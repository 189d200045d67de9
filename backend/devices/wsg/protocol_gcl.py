"""WSG text protocol GCL."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from decimal import Decimal
from typing import TypeAlias

from touchdown.backend.devices.framing import LineStream, WireError

LONGEST = 256
LARGEST = 1e9

_NAME = rb"[A-Z][A-Z0-9]*(?:\[[0-9]{1,3}\])?"
_CALL = re.compile(rb"([A-Z][A-Z0-9]*)\((.*)\)")
_QUERY = re.compile(rb"(" + _NAME + rb")\?")
_ASSIGNMENT = re.compile(rb"(" + _NAME + rb")=(.*)")
_ANSWER = re.compile(rb"(ACK|FIN) ([A-Z][A-Z0-9]*)")
_ERROR = re.compile(rb"ERR ([A-Z][A-Z0-9]*) ([0-9]{1,5})(?: (.*))?")
_ARGUMENT = re.compile(r'"([^"]*)"|(true|false)|([-+0-9.]+)')
_PRINTABLE = re.compile(rb"[ -~]*")

Scalar: TypeAlias = float | int | str | bool


@dataclass(frozen=True, slots=True)
class Call:
    """``COMMAND(arguments)``; a text argument travels in quotation marks."""

    command: str
    arguments: tuple[Scalar, ...] = ()


@dataclass(frozen=True, slots=True)
class Query:
    """``NAME?``."""

    name: str


@dataclass(frozen=True, slots=True)
class Assignment:
    """``NAME=value``: set, echoed, or the answer to a query; text is kept as it stands."""

    name: str
    value: Scalar | tuple[Scalar, ...]


@dataclass(frozen=True, slots=True)
class Answer:
    """``ACK`` accepted, ``FIN`` carried out."""

    kind: str
    command: str


@dataclass(frozen=True, slots=True)
class Failure:
    """``ERR``: a status code of the binary protocol, and a text in verbose mode."""

    command: str
    code: int
    text: str = ""


Line = Call | Query | Assignment | Answer | Failure


def encode(line: Line) -> bytes:
    """Return the line with its LF; raises ``WireError`` unless it reads back as the same."""
    content = _text(line).encode("ascii", "replace")
    if decode(content) != line:
        raise WireError("text", "gcl line")
    return content + b"\n"


def decode(content: bytes) -> Line:
    """Return the message of one line without its end; raises ``WireError``."""
    if len(content) > LONGEST or _PRINTABLE.fullmatch(content) is None:
        raise WireError("text", "gcl line")
    if found := _ANSWER.fullmatch(content):
        return Answer(found[1].decode(), found[2].decode())
    if found := _ERROR.fullmatch(content):
        return Failure(found[1].decode(), int(found[2]), (found[3] or b"").decode())
    if found := _CALL.fullmatch(content):
        return Call(found[1].decode(), _arguments(found[2].decode()))
    if found := _QUERY.fullmatch(content):
        return Query(found[1].decode())
    if found := _ASSIGNMENT.fullmatch(content):
        return Assignment(found[1].decode(), _value(found[2].decode()))
    raise WireError("text", "gcl line")


def lines() -> LineStream[Line]:
    """Return the decoder of either direction; takes LF and CR LF."""
    return LineStream(decode, LONGEST)


def _text(line: Line) -> str:
    match line:
        case Answer(kind, command):
            return f"{kind} {command}"
        case Failure(command, code, text):
            return f"ERR {command} {code} {text}" if text else f"ERR {command} {code}"
        case Call(command, arguments):
            return f"{command}({_joined(arguments)})"
        case Query(name):
            return f"{name}?"
        case Assignment(name, tuple() as values):
            return f"{name}=[{_joined(values)}]"
        case Assignment(name, str() | int() | float() as value):
            return f"{name}={_number_text(value)}"
    raise WireError("type", "gcl line")


def _joined(values: tuple[Scalar, ...]) -> str:
    return ",".join(f'"{v}"' if isinstance(v, str) else _number_text(v) for v in values)


def _number_text(value: Scalar) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        if not math.isfinite(value) or abs(value) > LARGEST:
            raise WireError("range", "gcl number")
        return f"{Decimal(repr(value)):f}"
    return str(value)


def _number(text: str) -> float | int:
    if re.fullmatch(r"[-+]?[0-9]{1,15}", text):
        return int(text)
    if re.fullmatch(r"[-+]?[0-9]{1,15}\.[0-9]*", text):
        return float(text)
    raise WireError("number", "gcl number")


def _arguments(text: str) -> tuple[Scalar, ...]:
    arguments: list[Scalar] = []
    at = 0
    while text:
        found = _ARGUMENT.match(text, at)
        if found is None:
            raise WireError("text", "gcl arguments", at)
        quoted, truth, number = found.groups()
        value = quoted if quoted is not None else truth == "true" if truth else _number(number)
        arguments.append(value)
        at = found.end()
        if at == len(text):
            break
        if text[at] != ",":
            raise WireError("text", "gcl arguments", at)
        at += 1
    return tuple(arguments)


def _value(text: str) -> Scalar | tuple[Scalar, ...]:
    if text.startswith("[") and text.endswith("]"):
        return _arguments(text[1:-1])
    if text in ("true", "false"):
        return text == "true"
    try:
        return _number(text)
    except WireError:
        return text
