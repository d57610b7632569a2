"""The model description of a co-simulation unit, in the XML of FMI 3.0 and 2.0."""

from __future__ import annotations

import xml.etree.ElementTree as Xml
from collections.abc import Mapping
from typing import Any

INPUT, STATE, START, OUTSIDE = 1, 101, 201, 300
"""First value references; `instance.h` counts in the same way."""
NAME = "model"


def description(card: Mapping[str, Any], token: str, version: str) -> str:
    """Return modelDescription.xml for `version` 3.0 or 2.0."""
    newer = version == "3.0"
    root = Xml.Element(
        "fmiModelDescription",
        {
            "fmiVersion": version,
            "modelName": card["model"],
            "instantiationToken" if newer else "guid": token,
            "generationTool": f"residnet {card['versions']['residnet']}",
            "description": "A vessel model; units are SI and radians. resources/card.json says"
            " more.",
        }
        | ({} if newer else {"variableNamingConvention": "flat", "numberOfEventIndicators": "0"}),
    )
    unit = {"modelIdentifier": NAME, "canHandleVariableCommunicationStepSize": "true"}
    dt = repr(float(card["dt"]))
    if newer:
        unit |= {"canGetAndSetFMUState": "true", "fixedInternalStepSize": dt}
    else:
        unit |= {"canGetAndSetFMUstate": "true"}
    co_simulation = Xml.SubElement(root, "CoSimulation", unit)
    if not newer:
        files = Xml.SubElement(co_simulation, "SourceFiles")
        for file in ("fmi2.c", "model_code.c"):
            Xml.SubElement(files, "File", name=file)
    Xml.SubElement(Xml.SubElement(root, "LogCategories"), "Category", name="logStatusError")
    Xml.SubElement(root, "DefaultExperiment", startTime="0", stepSize=dt)
    variables = Xml.SubElement(root, "ModelVariables")
    references = _variables(variables, card, newer)
    structure = Xml.SubElement(root, "ModelStructure")
    parent = structure if newer else Xml.SubElement(structure, "Outputs")
    for reference, index in references:
        if newer:
            Xml.SubElement(parent, "Output", valueReference=str(reference))
        else:
            Xml.SubElement(parent, "Unknown", index=str(index))
    if not newer:
        Xml.SubElement(structure, "InitialUnknowns").extend(
            Xml.Element("Unknown", index=str(index)) for _, index in references
        )
    else:
        for reference, _ in references:
            Xml.SubElement(structure, "InitialUnknown", valueReference=str(reference))
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _variables(parent: Xml.Element, card: Mapping[str, Any], newer: bool) -> list[tuple[int, int]]:
    """Write the variables; return reference and index of each output."""
    listed: list[tuple[str, int, str, str, str | None, str]] = []
    if newer:
        listed.append(("time", 0, "independent", "continuous", None, "s"))
    listed += [
        (entry["name"], INPUT + i, "input", "discrete", "0", entry["unit"])
        for i, entry in enumerate(card["inputs"])
    ]
    listed += [
        (entry["name"], STATE + i, "output", "discrete", None, entry["unit"])
        for i, entry in enumerate(card["states"])
    ]
    listed += [
        (f"{entry['name']}_start", START + i, "parameter", "fixed", "0", entry["unit"])
        for i, entry in enumerate(card["states"])
    ]
    outputs = []
    for index, (name, reference, causality, variability, start, unit) in enumerate(listed, start=1):
        if causality == "output":
            outputs.append((reference, index))
        common = {
            "name": name,
            "valueReference": str(reference),
            "causality": causality,
            "variability": variability,
            "description": unit,
        }
        value: dict[str, str] = {} if start is None else {"start": start}
        if newer:
            Xml.SubElement(parent, "Float64", common | value)
        else:
            Xml.SubElement(Xml.SubElement(parent, "ScalarVariable", common), "Real", value)
    common = {
        "name": "outside",
        "valueReference": str(OUTSIDE),
        "causality": "output",
        "variability": "discrete",
        "description": "beyond the training range, or an input that is no number",
    }
    outputs.append((OUTSIDE, len(listed) + 1))
    if newer:
        Xml.SubElement(parent, "Boolean", common)
    else:
        Xml.SubElement(Xml.SubElement(parent, "ScalarVariable", common), "Boolean")
    return outputs
