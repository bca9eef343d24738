"""Messages of MCAP channels that others wrote, as flat rows: protobuf and JSON.

Nested names are joined by dots. Numbers, truth values and words are kept; lists, bytes and maps are not
signals.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from ingest.errors import LogError

Decoder = Callable[[bytes], dict[str, Any]]


def decoder(channel: Channel, schema: Schema | None) -> Decoder:
    """What turns a message of ``channel`` into a row.

    Raises:
        LogError: here, if the encoding is neither protobuf nor JSON or the schema cannot be understood; from
            the decoder, if a message is not what the schema says.
    """
    where = f"channel {channel.topic}"
    if channel.message_encoding == "json":
        return lambda data: dict(_flat_json(_parse(where, json.loads, data), ""))
    decode = _parse(where, DecoderFactory().decoder_for, channel.message_encoding, schema)
    if decode is None:
        raise LogError(f"{where} was skipped: encoding {channel.message_encoding!r}; known: protobuf, json")
    return lambda data: dict(_flat_protobuf(_parse(where, decode, data), ""))


def _parse(where: str, function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except (ValueError, TypeError, KeyError, McapError, DecodeError) as error:
        raise LogError(f"{where} cannot be decoded: {error}") from error


def _flat_json(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat_json(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, bool | int | float | str):
        yield name or "value", value


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
