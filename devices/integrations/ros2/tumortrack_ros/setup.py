"""Installs the node, the launch file, its parameters and the views where ROS 2 looks for them."""

from glob import glob

from setuptools import setup

NAME = "tumortrack_ros"
SHARE = f"share/{NAME}"

setup(
    name=NAME,
    version="0.3.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        *((f"{SHARE}/{folder}", glob(f"{folder}/*")) for folder in ("launch", "config", "rviz")),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The tumortrack authors",
    maintainer_email="tumortrack@example.org",
    description="A node, a launch file and RViz views for tumortrack",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"track = {NAME}.track_node:main",
            f"execute = {NAME}.execute_node:main",
        ]
    },
)
