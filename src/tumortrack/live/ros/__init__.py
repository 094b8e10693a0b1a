"""The ROS graph, and its messages without ROS. ROS is in metres and everything else here in
millimetres: both become each other in these files and in no other."""
