"""What the registered metrics say of themselves: the description of a metrics record, and the scores in aveval(1).

`python -m avcli.formats` writes the schema, the keys in avcli-formats(5) and the scores in aveval(1).
"""

from collections.abc import Iterator

from avcli.formats.descriptions import Format
from avcli.formats.schema import Choice, Key, Kind, ListOf, Number, Numbers, Object, Text, Written
from avcli.metrics import registry
from avcli.metrics.hota import ALPHA
from avcli.metrics.metric import Field

_BETTER = {"up": "higher is better", "down": "lower is better"}


def describe() -> Format:
    """Describe the record that aveval writes, with a section for each registered metric."""
    sections = {
        metric.name: Key(Object({field.name: _key(field, field.kind) for field in metric.fields}), metric.text)
        for metric in registry.every_metric()
    }
    summary = Object({field.name: _key(field, "number") for field in registry.summary_fields()})
    return Format(
        "metrics",
        "The scores of one tracker or sensor on one sequence, or on all sequences together; scores are fractions",
        Object(
            {
                "sequence": Key(Text(), 'name of the sequence; all sequences together are "combined"', required=True),
                "tracker": Key(Text(), "name of the tracks; with summary"),
                "sensor": Key(Text(), "name of the sensor; with Detections"),
                "average": Key(Choice(("micro", "macro")), "how the sequences were combined"),
                "sequences": Key(ListOf(Text()), "names of the sequences that were combined"),
                "people": Key(Choice(("speaking",)), "only people who speak were scored (aveval --speaking)"),
                # Written: avcli-formats(5) would otherwise repeat the fields of the sections.
                "summary": Key(Written(summary.schema()), "the scores of aveval(1), curves by their means"),
                **sections,
            },
            rules={"oneOf": [{"required": ["tracker", "summary"]}, {"required": ["sensor", "Detections"]}]},
        ),
    )


def score_list() -> str:
    """Return the list of the scores that summaries and tables show, in the language of manual pages (mdoc)."""
    return "\n".join(_listed()) + "\n"


def with_score_list(page: str) -> str:
    """Return a manual page with the list between its marker comments written anew.

    Raises:
        ValueError: the page lacks the marker comments.
    """
    begin, end = '.\\" scores, written by make formats\n', '.\\" end of scores\n'
    before, begun, rest = page.partition(begin)
    _, ended, after = rest.partition(end)
    if not begun or not ended:
        raise ValueError("the marker comments of the list of scores are missing")
    return f"{before}{begin}{score_list()}{end}{after}"


def _key(field: Field, kind: str) -> Key:
    kinds: dict[str, Kind] = {
        "number": Number(),
        "curve": Numbers(ALPHA.size),
        "vector": ListOf(Number()),
        "word": Text(),
    }
    unit = "" if field.unit in ("%", "count", "") else f"{field.unit}; "
    return Key(kinds[kind], unit + field.text, required=not field.optional)


def _listed() -> Iterator[str]:
    yield ".Bl -tag -width Ds -compact"
    for field in registry.summary_fields():
        yield from _item(field)
    yield ".El"
    yield ".Pp"
    yield "Of a sensor:"
    yield ".Bl -tag -width Ds -compact"
    for field in registry.sensor_columns():
        yield from _item(field)
    yield ".El"


def _item(field: Field) -> tuple[str, str]:
    unit = "" if field.unit in ("%", "count", "") else f", in {field.unit}"
    better = f"; {_BETTER[field.better]}" if field.better else ""
    return f".It Li {field.name}", f"{field.text[:1].upper()}{field.text[1:]}{unit}{better}."


METRICS = describe()
"""The description of a metrics record."""
