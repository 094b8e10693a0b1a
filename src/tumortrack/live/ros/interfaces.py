"""Message types that rosbags lacks, by their public interfaces: MoveIt's, and those that it uses.

They are the same from Humble to Lyrical (moveit_msgs, octomap_msgs, object_recognition_msgs; BSD).
Constants, which are not sent, are left out.
"""

from __future__ import annotations

INTERFACES = {
    "object_recognition_msgs/msg/ObjectType": """
        string type
        string db
    """,
    "octomap_msgs/msg/Octomap": """
        std_msgs/Header header
        bool binary
        string id
        float64 resolution
        int8[] data
    """,
    "octomap_msgs/msg/OctomapWithPose": """
        std_msgs/Header header
        geometry_msgs/Pose origin
        octomap_msgs/Octomap octomap
    """,
    "moveit_msgs/msg/CollisionObject": """
        std_msgs/Header header
        geometry_msgs/Pose pose
        string id
        object_recognition_msgs/ObjectType type
        shape_msgs/SolidPrimitive[] primitives
        geometry_msgs/Pose[] primitive_poses
        shape_msgs/Mesh[] meshes
        geometry_msgs/Pose[] mesh_poses
        shape_msgs/Plane[] planes
        geometry_msgs/Pose[] plane_poses
        string[] subframe_names
        geometry_msgs/Pose[] subframe_poses
        byte operation
    """,
    "moveit_msgs/msg/AttachedCollisionObject": """
        string link_name
        CollisionObject object
        string[] touch_links
        trajectory_msgs/JointTrajectory detach_posture
        float64 weight
    """,
    "moveit_msgs/msg/RobotState": """
        sensor_msgs/JointState joint_state
        sensor_msgs/MultiDOFJointState multi_dof_joint_state
        AttachedCollisionObject[] attached_collision_objects
        bool is_diff
    """,
    "moveit_msgs/msg/AllowedCollisionEntry": """
        bool[] enabled
    """,
    "moveit_msgs/msg/AllowedCollisionMatrix": """
        string[] entry_names
        AllowedCollisionEntry[] entry_values
        string[] default_entry_names
        bool[] default_entry_values
    """,
    "moveit_msgs/msg/LinkPadding": """
        string link_name
        float64 padding
    """,
    "moveit_msgs/msg/LinkScale": """
        string link_name
        float64 scale
    """,
    "moveit_msgs/msg/ObjectColor": """
        string id
        std_msgs/ColorRGBA color
    """,
    "moveit_msgs/msg/PlanningSceneWorld": """
        CollisionObject[] collision_objects
        octomap_msgs/OctomapWithPose octomap
    """,
    "moveit_msgs/msg/PlanningScene": """
        string name
        RobotState robot_state
        string robot_model_name
        geometry_msgs/TransformStamped[] fixed_frame_transforms
        AllowedCollisionMatrix allowed_collision_matrix
        LinkPadding[] link_padding
        LinkScale[] link_scale
        ObjectColor[] object_colors
        PlanningSceneWorld world
        bool is_diff
    """,
    "moveit_msgs/msg/RobotTrajectory": """
        trajectory_msgs/JointTrajectory joint_trajectory
        trajectory_msgs/MultiDOFJointTrajectory multi_dof_joint_trajectory
    """,
}
