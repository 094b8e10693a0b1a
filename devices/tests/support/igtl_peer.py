"""A tracker as PlusServer is one: pyigtl's server, in a process of its own, for it takes signals.

igtl_peer.py TOOL POSE      says its port; then with each line of standard input 0.4 s of poses of
                            two tools, of which ours, at the POSE, touches from 0.1 s on, beside an
                            image; and an empty line when it is done
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import pyigtl

server = pyigtl.OpenIGTLinkServer(port=0)
print(server.server_address[1], flush=True)
tool, pose = sys.argv[1], np.array(json.loads(sys.argv[2]))
image = np.zeros((4, 5, 6), np.uint8)


def tell(*messages: pyigtl.messages.MessageBase) -> None:
    for message in messages:
        server.send_message(message, wait=False)  # else each takes 10 ms


for _ in sys.stdin:
    for n in range(40):
        contact = pyigtl.StringMessage("1" if n >= 10 else "0", device_name="contact")
        other = pyigtl.TransformMessage(np.eye(4), device_name="Other")
        tell(pyigtl.ImageMessage(image, device_name="Image_Reference"), other)
        tell(pyigtl.TransformMessage(pose, device_name=tool), contact)
        time.sleep(0.01)
    print(flush=True)
server.stop()
