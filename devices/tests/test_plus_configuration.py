"""The configuration for PlusServer to start from: what it names is there, and all that it sends can
be reached from the tracker. PlusServer itself is not run."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from tumortrack.live.session import named_tools
from tumortrack_devices.igtl.message import LONGEST_DEVICE

FILE = Path(__file__).parents[1] / "integrations" / "plus" / "tumortrack.xml"
HOW_TO = Path(__file__).parents[2] / "docs" / "how-to" / "evidence.md"
ROOT = ET.parse(FILE).getroot()


def named(path: str, attribute: str) -> list[str]:
    return [one.attrib[attribute] for one in ROOT.findall(path)]


def edges() -> set[tuple[str, str]]:
    """Known transforms: of the tracker's tools, and those that are defined."""
    tools = named(".//DataSources/DataSource[@Type='Tool']", "Id")
    (tracker,) = named(".//Device[@Id='TrackerDevice']", "ToolReferenceFrame")
    defined = ROOT.findall("CoordinateDefinitions/Transform")
    return {(one, tracker) for one in tools} | {(o.attrib["From"], o.attrib["To"]) for o in defined}


def reached(start: str) -> set[str]:
    """All frames that a frame is connected to."""
    found: set[str] = set()
    front = {start}
    while front:
        found |= front
        front = {b for a, b in edges() | {(b, a) for a, b in edges()} if a in found} - found
    return found


def test_each_channel_and_source_that_is_named_is_there():
    assert ROOT.tag == "PlusConfiguration"
    channels = named(".//OutputChannel", "Id")
    assert len(set(channels)) == len(channels) == 3
    assert set(named(".//InputChannel", "Id")) < set(channels)
    (server,) = ROOT.findall("PlusOpenIGTLinkServer")
    assert server.attrib["OutputChannelId"] in channels
    assert server.attrib["SendValidTransformsOnly"] == "true"  # none, where a tool is hidden
    for device in ROOT.findall(".//Device"):
        sources = [one.attrib["Id"] for one in device.findall("DataSources/DataSource")]
        for channel in device.findall("OutputChannels/OutputChannel"):
            given = [one.attrib["Id"] for one in channel.findall("DataSource")]
            given += filter(None, [channel.get("VideoDataSourceId")])
            assert set(given) <= set(sources)


def test_all_that_is_sent_can_be_reached_from_the_tracker():
    sent = named(".//TransformNames/Transform", "Name")
    assert sent == ["ProbeToTracker", "StylusTipToTracker", "ReferenceToTracker"]
    for name in sent:
        start, end = name.split("To")
        assert end in reached(start)
        assert len(name) <= LONGEST_DEVICE
    for image in ROOT.findall(".//ImageNames/Image"):
        assert image.attrib["EmbeddedTransformToFrame"] in reached(image.attrib["Name"])
    for one in ROOT.findall("CoordinateDefinitions/Transform"):
        matrix = np.array(one.attrib["Matrix"].split(), float).reshape(4, 4)
        assert np.linalg.det(matrix) == pytest.approx(1)


def test_the_how_to_asks_for_what_is_sent_where_it_is_sent():
    text = HOW_TO.read_text(encoding="utf-8")
    assert FILE.relative_to(HOW_TO.parents[2]).as_posix() in text
    (spec,) = re.findall(r'--tool "(pointer=openigtlink:\S+)"', text)
    (tool,) = named_tools([spec]).values()
    assert tool.name in named(".//TransformNames/Transform", "Name")
    assert tool.port_text == ROOT.find("PlusOpenIGTLinkServer").attrib["ListeningPort"]
