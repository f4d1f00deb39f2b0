"""Everything is in pyproject.toml but this: configs/ at the root is installed as pipeline/configs."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["auglidar_base*", "completion*", "detection*", "pipeline*"]), "pipeline.configs"],
    package_dir={"pipeline.configs": "configs"},
)
