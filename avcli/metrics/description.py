"""What the metrics' fields say of themselves: the description of a metrics record, and the list of scores in aveval(1).

`python -m avcli.metrics` writes that list; the schema and the list in avcli-formats(5) follow from `METRICS`.
"""

from collections.abc import Iterator

from avcli.formats.descriptions import Format
from avcli.formats.schema import Choice, Key, Kind, ListOf, Number, Numbers, Object, Text
from avcli.metrics import registry
from avcli.metrics.hota import ALPHA
from avcli.metrics.metric import Field

_BETTER = {"up": "higher is better", "down": "lower is better", "": ""}


def metrics_record() -> Format:
    """Describe the record that aveval writes, with a section for each registered metric."""
    sections = {
        metric.name: Key(Object({field.name: _key(field, field.kind) for field in metric.fields}), metric.text)
        for metric in (*registry.METRICS, registry.SENSOR_METRIC)
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
                "summary": Key(summary, "one number for each score; curves by their means"),
                **sections,
            },
            rules={"oneOf": [{"required": ["tracker", "summary"]}, {"required": ["sensor", "Detections"]}]},
        ),
    )


def score_list() -> str:
    """Return the list of all scores in the language of manual pages (mdoc)."""
    return "\n".join(_listed()) + "\n"


def with_score_list(page: str) -> str:
    """Return a manual page with the list between its marker comments written anew.

    Raises:
        ValueError: the page lacks the marker comments.
    """
    begin, end = '.\\" scores, written by python -m avcli.metrics\n', '.\\" end of scores\n'
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
    return Key(kinds[kind], _phrase(field), required=not field.optional)


def _phrase(field: Field) -> str:
    unit = "" if field.unit in ("%", "count") else f", {field.unit}" if field.unit else ""
    return "; ".join(filter(None, (field.text + unit, _BETTER[field.better])))


def _listed() -> Iterator[str]:
    yield ".Bl -tag -width Ds"
    for metric in (*registry.METRICS, registry.SENSOR_METRIC):
        yield f".It Li {metric.name}"
        yield f"{metric.text[:1].upper()}{metric.text[1:]}."
        yield ".Bl -tag -width Ds -compact"
        for field in metric.fields:
            yield f".It Li {field.name}"
            phrase = _phrase(field)
            yield f"{phrase[:1].upper()}{phrase[1:]}."
        yield ".El"
    yield ".El"
