"""JSON Schema 2020-12, imported where a test validates: jsonschema compiles 38 grammars, which takes three seconds."""

from functools import cached_property
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jsonschema import Draft202012Validator
    from referencing import Registry


class Schema:
    """A schema that values are held against; ``registry`` holds the documents that it refers to."""

    def __init__(self, document: dict[str, Any], *, registry: "Registry[Any] | None" = None) -> None:
        self._document, self._registry = document, registry

    @cached_property
    def _validator(self) -> "Draft202012Validator":
        from jsonschema import Draft202012Validator

        if self._registry is None:
            return Draft202012Validator(self._document)
        formats = Draft202012Validator.FORMAT_CHECKER
        return Draft202012Validator(self._document, registry=self._registry, format_checker=formats)

    def validate(self, value: object) -> None:
        """Raise jsonschema's ValidationError if the value does not keep to the schema."""
        self._validator.validate(value)

    def is_valid(self, value: object) -> bool:
        """Return whether the value keeps to the schema."""
        return bool(self._validator.is_valid(value))

    def errors(self, value: object) -> list[str]:
        """Return what the value does not keep to."""
        return [error.message for error in self._validator.iter_errors(value)]
