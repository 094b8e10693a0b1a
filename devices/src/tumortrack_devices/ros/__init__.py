"""ROS graphs and messages, with or without ROS installed. ROS uses metres, everything else here
millimetres; only these files convert between them."""
