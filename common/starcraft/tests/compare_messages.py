"""Holds our messages against the classes of the published Python package s2clientprotocol.

Reads a FileDescriptorSet of ours on standard input. Every message, field and value of an enum must be theirs, by name,
number and type. Then prints requests and responses at random, made of our fields by their classes, one a line in
hexadecimal digits; `round_trip.rs` reads them.
"""

import random
import sys

from google.protobuf import descriptor_pb2
from s2clientprotocol import common_pb2, data_pb2, debug_pb2, error_pb2, raw_pb2, sc2api_pb2

MODULES = [common_pb2, data_pb2, debug_pb2, error_pb2, raw_pb2, sc2api_pb2]
MESSAGES = 400
FIELD = descriptor_pb2.FieldDescriptorProto
# Their enum where we have its numbers.
AS_NUMBERS = {("ResponseAction", "result")}


def theirs(kind, name):
    for module in MODULES:
        found = getattr(module.DESCRIPTOR, kind).get(name)
        if found is not None:
            return found
    sys.exit(f"s2clientprotocol has no {name}")


def plain(name, enum):
    """What a value of ours is called without the prefix that our generator wants."""
    words = "".join("_" + c if c.isupper() and not enum[at - 1 : at].isupper() else c for at, c in enumerate(enum))
    prefix = words.strip("_").upper() + "_"
    return name.removeprefix(prefix).replace("_", "").lower()


def check_enum(ours, enum, where):
    numbers = {value.number: value.name for value in enum.values}
    for value in ours.value:
        # Ours begin with 0, which theirs mostly have not.
        if value.name.endswith("_UNSPECIFIED"):
            assert value.number == 0 and 0 not in numbers, f"{where}: 0 is {numbers.get(0)}"
            continue
        name = numbers.get(value.number, "nothing")
        assert plain(value.name, ours.name) == name.replace("_", "").lower(), f"{where}: {value.name} is {name}"


def check_message(ours, message):
    for field in ours.field:
        where = f"{ours.name}.{field.name}"
        their = message.fields_by_name.get(field.name)
        assert their is not None, f"{where} is not there"
        assert their.number == field.number, f"{where} is {their.number}, not {field.number}"
        assert their.label == field.label, f"{where} is repeated in one only"
        if (ours.name, field.name) in AS_NUMBERS:
            assert (their.type, field.type) == (FIELD.TYPE_ENUM, FIELD.TYPE_INT32), where
            continue
        assert their.type == field.type, f"{where} has the type {their.type}, not {field.type}"
        kind = their.message_type or their.enum_type
        if kind is not None:
            assert "." + kind.full_name == field.type_name, f"{where} is a {kind.full_name}"
    for enum in ours.enum_type:
        check_enum(enum, message.enum_types_by_name[enum.name], f"{ours.name}.{enum.name}")


def scalar(field, rng):
    if field.type == FIELD.TYPE_FLOAT:
        return rng.uniform(-100, 100)
    if field.type == FIELD.TYPE_STRING:
        return rng.choice(["", "Marine_RL", "naïve", "x" * 300])
    if field.type == FIELD.TYPE_BYTES:
        return rng.randbytes(rng.randrange(40))
    if field.type == FIELD.TYPE_BOOL:
        return rng.random() < 0.5
    if field.type == FIELD.TYPE_ENUM:
        return rng.choice(field.enum_type.values).number
    signed = field.type in (FIELD.TYPE_INT32, FIELD.TYPE_INT64)
    bits = 63 if field.type in (FIELD.TYPE_UINT64, FIELD.TYPE_INT64) else 31
    return rng.randrange(-(1 << bits) if signed else 0, 1 << bits)


def fill(to, messages, rng):
    """Sets some of the fields that we know, at random."""
    fields = messages[to.DESCRIPTOR.full_name]
    chosen = {oneof.name: rng.choice([f.name for f in oneof.fields if f.name in fields]) for oneof in to.DESCRIPTOR.oneofs}
    for field in to.DESCRIPTOR.fields:
        oneof = field.containing_oneof
        if field.name not in fields or (oneof is not None and chosen[oneof.name] != field.name):
            continue
        # What a oneof chose is set, even if to nothing: it says which request it is.
        if oneof is None and rng.random() < 0.3:
            continue
        for _ in range(rng.randrange(1, 4) if field.label == FIELD.LABEL_REPEATED else 1):
            repeated = field.label == FIELD.LABEL_REPEATED
            if field.message_type is not None:
                part = getattr(to, field.name)
                part = part.add() if repeated else part
                part.SetInParent()
                fill(part, messages, rng)
            elif repeated:
                getattr(to, field.name).append(scalar(field, rng))
            else:
                setattr(to, field.name, scalar(field, rng))


def main():
    files = descriptor_pb2.FileDescriptorSet.FromString(sys.stdin.buffer.read())
    messages = {}
    for file in files.file:
        for ours in file.message_type:
            check_message(ours, theirs("message_types_by_name", ours.name))
            messages[f"{file.package}.{ours.name}"] = {field.name for field in ours.field}
        for enum in file.enum_type:
            check_enum(enum, theirs("enum_types_by_name", enum.name), enum.name)
    rng = random.Random(1)
    for _ in range(MESSAGES):
        for of in (sc2api_pb2.Request, sc2api_pb2.Response):
            message = of()
            fill(message, messages, rng)
            print(of.__name__, message.SerializeToString(deterministic=True).hex())


main()
