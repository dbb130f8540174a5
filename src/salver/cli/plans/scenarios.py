"""`salver scenarios`: list the ready-made scenarios."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from salver.cli.common import Json, print_json, result_console

if TYPE_CHECKING:
    from salver.scenario import Scenario


def scenarios(
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON schema of a scenario file instead.")] = False,
    json: Json = False,
) -> None:
    """List the ready-made scenarios.

    With the schema, editors complete and check your file, if its first line is `#:schema scenario.schema.json`.

    Example: `salver scenarios`, or `salver scenarios --schema > scenario.schema.json`
    """
    from salver import scenario as model

    if schema:
        print_json({"$schema": "https://json-schema.org/draft/2020-12/schema", **model.Scenario.model_json_schema()})
        return
    found = [model.load(name) for name in model.names()]
    if json:
        print_json([_record(item) for item in found])
        return

    from rich.padding import Padding
    from rich.text import Text

    out = result_console()
    for item in found:
        kinds = dict.fromkeys(parameter.kind for parameter in item.uncertain.parameters)
        facts = f"{item.facts()['way']}; {item.facts()['carried']}; uncertain: {', '.join(kinds) or 'nothing'}"
        out.print(Text.assemble((item.name, "bold"), f"  {facts}"))
        out.print(Padding(Text(item.summary), (0, 0, 0, 4)), soft_wrap=False)


def _record(item: Scenario) -> dict[str, Any]:
    uncertain = item.uncertain
    return {
        "name": item.name,
        "summary": item.summary,
        "source": item.source,
        "duration": item.motion.duration,
        "legs": len(item.each_leg),
        "objects": [
            {"name": o.name, "shape": o.shape.type, "mass": o.mass, "friction": o.friction} for o in item.objects
        ],
        "uncertain": {
            name: {"nominal": nominal, "half_range": half}
            for name, nominal, half in zip(uncertain.names, uncertain.nominal, uncertain.half_range, strict=True)
        },
        "arm": item.arm.model if item.arm else None,
        "digest": item.digest,
    }
