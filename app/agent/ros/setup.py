"""The ament_python package ``fleetmap_ros``."""

from setuptools import setup

NAME = "fleetmap_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/fleetmap_agent.launch.py"]),
        (f"share/{NAME}/config", ["config/fleetmap_agent.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="Fleet Map Server",
    maintainer_email="maintainers@fleet-map-server.invalid",
    description="Keeps a robot's maps up to date with a channel of a Fleet Map Server and loads them into Nav2.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["fleetmap_agent = fleetmap_ros.node:main"]},
)
