from setuptools import setup

NAME = "salver_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/carry.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Carries loose objects on a tray through ros2_control",
    license="Apache-2.0",
    maintainer="The salver developers",
    maintainer_email="salver@example.com",
    entry_points={"console_scripts": [f"carry = {NAME}.node:main", f"mock_arm = {NAME}.mock:main"]},
)
