"""What would break a program that was written against an earlier contract: ``broken(old, new)`` lists it in words.

What was taken has to be taken still; what was promised has to come.
"""

from collections.abc import Iterator
from typing import Any

from tests.support.contract.document import parameters_of

Schema = dict[str, Any]
LOWER = ("minimum", "exclusiveMinimum", "minLength", "minItems")
UPPER = ("maximum", "exclusiveMaximum", "maxLength", "maxItems")
DEEPEST = 12


def broken(old: Schema, new: Schema) -> list[str]:
    """List what breaks; empty where nothing does."""
    return sorted(set(_paths(old, new)))


def _paths(old: Schema, new: Schema) -> Iterator[str]:
    for path, item in old["paths"].items():
        for method, before in item.items():
            after = new["paths"].get(path, {}).get(method)
            if after is None:
                yield f"{method.upper()} {path} is gone"
                continue
            yield from (f"{method.upper()} {path}: {what}" for what in _operation(old, new, before, after))


def _operation(old: Schema, new: Schema, before: Schema, after: Schema) -> Iterator[str]:
    known = {(one["in"], one["name"]): one for one in parameters_of(old, before)}
    there = {(one["in"], one["name"]): one for one in parameters_of(new, after)}
    for key, parameter in there.items():
        if parameter.get("required") and not known.get(key, {}).get("required"):
            yield f"parameter {key[1]} is required"
    for key, parameter in known.items():
        if key not in there:
            yield f"parameter {key[1]} is gone"
        else:
            yield from _sent(_Pair(old, new), parameter["schema"], there[key]["schema"], key[1])
    yield from _bodies(old, new, before, after)
    yield from _answers(old, new, before, after)


def _bodies(old: Schema, new: Schema, before: Schema, after: Schema) -> Iterator[str]:
    for media_type, part in before.get("requestBody", {}).get("content", {}).items():
        there = after.get("requestBody", {}).get("content", {}).get(media_type)
        if there is None:
            yield f"a body of {media_type} is not taken"
        else:
            yield from _sent(_Pair(old, new), part.get("schema", {}), there.get("schema", {}), "body")


def _answers(old: Schema, new: Schema, before: Schema, after: Schema) -> Iterator[str]:
    for status, answer in before["responses"].items():
        if not status.startswith("2"):
            continue
        if status not in after["responses"]:
            yield f"{status} is never answered"
            continue
        content = after["responses"][status].get("content", {})
        for media_type, part in answer.get("content", {}).items():
            if media_type not in content:
                yield f"{status} has no {media_type}"
            else:
                yield from _reported(
                    _Pair(old, new), part.get("schema", {}), content[media_type].get("schema", {}), status
                )


class _Pair:
    """The two documents, to follow references in."""

    def __init__(self, old: Schema, new: Schema) -> None:
        self._old, self._new = old, new

    def follow(self, before: Schema, after: Schema) -> tuple[Schema, Schema]:
        """Follow both schemas' references."""
        return _followed(self._old, before), _followed(self._new, after)


def _followed(document: Schema, schema: Schema) -> Schema:
    while "$ref" in schema:
        schema = document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return schema


def _sent(pair: _Pair, before: Schema, after: Schema, name: str, depth: int = 0) -> Iterator[str]:
    """List what was taken and is not any more."""
    before, after = pair.follow(before, after)
    if depth > DEEPEST:
        return
    yield from _narrower(before, after, name)
    yield from (f"{name}: {one!r} is not taken" for one in _values(before) - _values(after) if _values(after))
    for field in set(after.get("required", ())) - set(before.get("required", ())):
        yield f"{name}.{field} is required"
    for field, part in before.get("properties", {}).items():
        there = after.get("properties", {}).get(field)
        if there is None:
            if after.get("additionalProperties") is False:
                yield f"{name}.{field} is not taken"
        else:
            yield from _sent(pair, part, there, f"{name}.{field}", depth + 1)
    yield from _alike(pair, before, after, name, depth, _sent)


def _reported(pair: _Pair, before: Schema, after: Schema, name: str, depth: int = 0) -> Iterator[str]:
    """List what was promised and does not come any more."""
    before, after = pair.follow(before, after)
    if depth > DEEPEST:
        return
    if _types(before) and _types(after) - _types(before):
        yield f"{name} may be {', '.join(sorted(_types(after) - _types(before)))}"
    yield from (f"{name}: {one!r} is gone" for one in _values(before) - _values(after))
    for field, part in before.get("properties", {}).items():
        there = after.get("properties", {}).get(field)
        if there is None:
            yield f"{name}.{field} is gone"
            continue
        if field in before.get("required", ()) and field not in after.get("required", ()):
            yield f"{name}.{field} may be missing"
        yield from _reported(pair, part, there, f"{name}.{field}", depth + 1)
    yield from _alike(pair, before, after, name, depth, _reported)


def _alike(pair: _Pair, before: Schema, after: Schema, name: str, depth: int, compare: Any) -> Iterator[str]:
    """Compare items of arrays, and alternatives that both have, one by one."""
    if "items" in before and "items" in after:
        yield from compare(pair, before["items"], after["items"], f"{name}[]", depth + 1)
    for kind in ("anyOf", "oneOf"):
        for first, second in zip(before.get(kind, ()), after.get(kind, ()), strict=False):
            yield from compare(pair, first, second, name, depth + 1)
        if compare is _sent and len(after.get(kind, ())) < len(before.get(kind, ())) and kind in after:
            yield f"{name}: an alternative is not taken"


def _narrower(before: Schema, after: Schema, name: str) -> Iterator[str]:
    if _types(before) - _types(after) and _types(after):
        yield f"{name} is not taken as {', '.join(sorted(_types(before) - _types(after)))}"
    for bound in (*LOWER, *UPPER):
        if bound not in after:
            continue
        was = before.get(bound)
        if was is None or (after[bound] > was if bound in LOWER else after[bound] < was):
            yield f"{name}: {bound} is {after[bound]}, was {'without' if was is None else was}"
    if "pattern" in after and after["pattern"] != before.get("pattern"):
        yield f"{name}: pattern is {after['pattern']}, was {before.get('pattern', 'without')}"


def _types(schema: Schema) -> set[str]:
    kind = schema.get("type", ())
    return {kind} if isinstance(kind, str) else set(kind)


def _values(schema: Schema) -> set[Any]:
    return set(schema.get("enum", [schema["const"]] if "const" in schema else ()))
