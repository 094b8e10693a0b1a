"""ur_rtde in a process of its own (`clients.py`): what an arm's controller tells it, each 20 ms.

rtde_peer.py HOST COUNT
"""

from __future__ import annotations

import json
import sys
import time

from rtde_receive import RTDEReceiveInterface

receive = RTDEReceiveInterface(sys.argv[1])
for _ in range(int(sys.argv[2])):
    said = {"pose": receive.getActualTCPPose(), "force": receive.getActualTCPForce()}
    print(json.dumps(said | {"safety": receive.getSafetyMode()}), flush=True)
    time.sleep(0.02)
receive.disconnect()
