"""A node with ROS's own message classes, run by Debian's Python: ``ros1_peer.py COMMAND JSON``.

It shares nothing with tumortrack: what it says and hears is the tests' other witness.
"""

import json
import sys
import threading

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from visualization_msgs.msg import MarkerArray

WIDTH, HEIGHT = 64, 48


def depth(given):
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    if given.get("encoding") == "32FC1":
        values = (0.12 + 0.0005 * columns + 0.0001 * rows).astype(np.float32)
        values[10:14, 20:30] = np.nan
    else:
        values = (120 + columns + rows).astype(np.uint16)
        values[10:14, 20:30] = 0
    image = Image(height=HEIGHT, width=WIDTH, encoding=given.get("encoding", "16UC1"))
    image.step, image.data = WIDTH * values.itemsize, values.tobytes()
    return Image, image


def mask(given):
    values = np.zeros((HEIGHT, WIDTH), np.uint8)
    values[5:20, 7:40] = 255
    image = Image(height=HEIGHT, width=WIDTH, encoding="mono8", step=WIDTH, data=values.tobytes())
    return Image, image


def info(given):
    fx, fy, cx, cy = 60.0, 61.0, 31.5, 23.5
    message = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", D=[0.0] * 5)
    message.K = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    message.P = [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]
    return CameraInfo, message


def cloud(given):
    points = np.random.default_rng(3).normal([0, 0, 0.13], 0.02, (given.get("n", 300), 3))
    points = points.astype(np.float32)
    points[5] = np.nan
    fields = [PointField(name, 4 * k, PointField.FLOAT32, 1) for k, name in enumerate("xyz")]
    message = PointCloud2(height=1, width=len(points), fields=fields, point_step=12)
    message.row_step, message.data = 12 * len(points), points.tobytes()
    return PointCloud2, message


def publish(given):
    makers = {"depth": depth, "mask": mask, "info": info, "cloud": cloud}
    sent = []
    for topic, what in given["topics"].items():
        kind, message = makers[what](given)
        sent.append((rospy.Publisher(topic, kind, queue_size=2, tcp_nodelay=True), message))
    while not rospy.is_shutdown():
        stamp = rospy.Time.now()
        for sender, message in sent:
            message.header.stamp = stamp
            message.header.frame_id = "camera_depth_optical_frame"
            sender.publish(message)
        rospy.rostime.wallsleep(1 / given["hz"])


def heard_cloud(message):
    kinds = {PointField.FLOAT32: "<f4", PointField.UINT8: "u1"}
    layout = np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": [kinds[field.datatype] for field in message.fields],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    table = np.frombuffer(message.data, layout)
    return {name: table[name].tolist() for name in table.dtype.names if name != "rgb"}


def heard_markers(message):
    return {
        "markers": [
            {
                "ns": one.ns,
                "action": one.action,
                "frame": one.header.frame_id,
                "text": one.text,
                "opacity": one.color.a,
                "points": [[p.x, p.y, p.z] for p in one.points],
            }
            for one in message.markers
        ]
    }


def heard_diagnostics(message):
    (status,) = message.status
    return {
        "level": ord(status.level) if isinstance(status.level, bytes) else status.level,
        "message": status.message,
    }


def heard_place(message):
    return {"place": [message.point.x, message.point.y, message.point.z]}


def listen(given):
    one_at_a_time = threading.Lock()

    def listen_to(end, kind, read):
        topic = given["namespace"] + "/" + end

        def came(message):
            header = getattr(message, "header", None)
            said = {"topic": end, **read(message)}
            if header is not None:
                said["stamp_ns"], said["frame"] = header.stamp.to_nsec(), header.frame_id
            said["late_ns"] = rospy.Time.now().to_nsec() - said.get("stamp_ns", 0)
            with one_at_a_time:  # each connection has a thread
                print(json.dumps(said), flush=True)

        rospy.Subscriber(topic, kind, came, queue_size=None, tcp_nodelay=True)

    listen_to("cloud", PointCloud2, heard_cloud)
    listen_to("meshes", MarkerArray, heard_markers)
    listen_to("diagnostics", DiagnosticArray, heard_diagnostics)
    listen_to("tumor_1/center", PointStamped, heard_place)
    rospy.spin()


if __name__ == "__main__":
    command, given = sys.argv[1], json.loads(sys.argv[2])
    rospy.init_node("peer", anonymous=True, disable_rosout=True)
    {"publish": publish, "listen": listen}[command](given)
