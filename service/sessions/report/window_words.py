"""A window in words, for the report."""

from service.core.schemas.windows import Window


def window_text(window: Window) -> str:
    """Return the conditions of a window in words, with their edges and the dwell."""
    stated = window.model_dump(exclude_none=True)
    further = stated.pop("further", [])
    join = f" {stated.pop('join', 'and')} "
    return join.join(_condition(one) for one in [stated, *further]) + f"; dwell {window.dwell_ms:g} ms"


def _condition(one: dict[str, object]) -> str:
    edges = [(name, one[name]) for name in one if name.startswith(("lower_", "upper_", "from_", "to_"))]
    unit = next((name.partition("_")[2] for name, _ in edges), "")
    low_high = " to ".join(f"{value:g}" for _, value in edges if isinstance(value, int | float))
    if not edges and one["kind"] == "breath_hold":
        low_high = "level as a held breath sets it"
    unit = {"percent": "% of the breath"}.get(unit, unit)
    return f"{str(one['kind']).replace('_', ' ')} of {one.get('name') or one['signal']}, {low_high} {unit}".rstrip()
