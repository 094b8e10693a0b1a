"""ROS messages without ROS: values <-> messages <-> bytes.

``messages`` makes any message of a distribution and its bytes, ``incoming`` reads what sensors
send, ``outgoing`` says what is published of a result. The library behind it is rosbags. ROS is in
metres and everything else here in millimetres: both become each other in these files and in no
other.
"""
