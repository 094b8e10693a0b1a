"""A structure that rides along with the organ reaches every sink."""

from dataclasses import replace

from live_objects import ball, empty_update, small_anatomy, small_setting, small_update
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.ros.results import ResultMessages
from tumortrack_devices.sinks.openigtlink import OpenIgtLinkSinkConfig


def test_every_sink_gets_it():
    vessel = ball((0.0, 0.0, 125.0), 3.0)
    update = small_update()
    estimate = replace(update.estimate, structures={"vessel": vessel})
    update = replace(update, estimate=estimate)
    anatomy = replace(small_anatomy(), structures={"vessel": vessel})
    context = replace(small_setting(), anatomy_ct=anatomy)
    messages = {out.suffix: out.message for out in ResultMessages(Messages(), context).of(update)}
    marker = next(one for one in messages["meshes"].markers if one.ns == "vessel")
    assert len(marker.points) == 3 * len(vessel.faces)
    sink = OpenIgtLinkSinkConfig(port=0).open(context)
    try:
        sent = {name: more for _, name, _, more in sink._surfaces(update)}
        assert "vessel" in sent
        gone = {name for _, name, _, _ in sink._surfaces(empty_update())}
        assert "vessel" in gone  # emptied, so that no old surface stays
    finally:
        sink.close()
