"""Messages of MCAP channels that others wrote, as flat rows: protobuf, JSON and ROS 2.

Nested names are joined by dots. Numbers, truth values and words are kept; lists, bytes and maps are not
signals.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from typing import Any

from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from ingest.errors import LogError
from ingest.readers import need

_WRONG = (
    ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError, struct.error, McapError,
    DecodeError,
)  # fmt: skip
ENCODINGS = "protobuf, json, cdr (ROS 2)"
Decoder = Callable[[bytes], dict[str, Any]]


def decoder(channel: Channel, schema: Schema | None) -> Decoder:
    """What turns a message of ``channel`` into a row.

    Raises:
        LogError: here, if the encoding is none of these or the schema cannot be understood; from the decoder,
            if a message is not what the schema says.
    """
    where = f"channel {channel.topic}"
    if channel.message_encoding == "json":
        return lambda data: dict(_flat_json(_parse(where, json.loads, data), ""))
    ros2 = channel.message_encoding == "cdr"
    factory = need("mcap_ros2.decoder", "ros2").DecoderFactory() if ros2 else DecoderFactory()
    decode = _parse(where, factory.decoder_for, channel.message_encoding, schema)
    if decode is None:
        raise LogError(f"{where} was skipped: encoding {channel.message_encoding!r}; known: {ENCODINGS}")
    flat = _flat_ros if ros2 else _flat_protobuf
    return lambda data: dict(flat(_parse(where, decode, data), ""))


def _parse(where: str, function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except _WRONG as error:
        raise LogError(f"{where} cannot be decoded: {error}") from error


def _flat_json(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat_json(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, bool | int | float | str):
        yield name or "value", value


def _flat_ros(message: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name in message.__slots__:
        value = getattr(message, name)
        if isinstance(value, bool | int | float | str):
            yield prefix + name, value
        elif hasattr(value, "__slots__"):
            yield from _flat_ros(value, f"{prefix}{name}.")


def _flat_protobuf(message: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for field in message.DESCRIPTOR.fields:
        if field.is_repeated or field.type == field.TYPE_BYTES:
            continue
        if field.has_presence and not message.HasField(field.name):
            continue
        value = getattr(message, field.name)
        if field.message_type is not None:
            yield from _flat_protobuf(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value
