"""Two arms that execute a resection: kinematics, collision checking, motion planning.

Millimetres and the table frame at every interface; metres only inside calls of pinocchio and coal.
"""
