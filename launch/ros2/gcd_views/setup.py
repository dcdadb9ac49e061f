"""Installed by `colcon build`; what else it needs is in package.xml."""

from setuptools import setup

NAME = "gcd_views"

setup(
    name=NAME,
    version="0.1.0",
    description="Virtual camera views of a gcd node as ROS 2 topics, with its diagnostics and its lifecycle.",
    maintainer="The gcd-node authors",
    maintainer_email="gcd-node@example.com",
    license="Apache-2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", [f"launch/{NAME}.launch.py"]),
    ],
    python_requires=">=3.10",
    install_requires=["gcd-client", "numpy"],
    entry_points={"console_scripts": [f"{NAME} = {NAME}.bridge:main"]},
)
