# AugLiDAR on a CPU.
#   docker build -t auglidar .      (with --build-arg PIP_EXTRA_INDEX_URL=..., PyTorch's index of CPU wheels, much smaller)
#   docker run --rm -v "$PWD/runs:/data/runs" auglidar
#   docker run --rm -v /path/to/KITTI:/data/KITTI:ro -v "$PWD/runs:/data/runs" auglidar \
#     --config configs/kitti.yaml --data KITTI --out runs/kitti --stage augment
FROM python:3.12-slim-bookworm

# Libraries that Open3D and OpenMP code load at run time; their versions are those of the Debian release named above.
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install -y --no-install-recommends libgl1 libgomp1 libusb-1.0-0 \
 && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/auglidar
COPY pyproject.toml setup.py MANIFEST.in README.md LICENSE ./
COPY auglidar_base auglidar_base
COPY completion completion
COPY detection detection
COPY pipeline pipeline
COPY configs configs
# Compiled numba kernels are kept beside the package, so the user who runs it has to own them.
ARG PIP_EXTRA_INDEX_URL=
RUN useradd --create-home --uid 1000 runner \
 && pip install --no-cache-dir . \
 && mkdir -p /data/runs && chown -R runner /data
ENV NUMBA_CACHE_DIR=/home/runner/.cache/numba MPLBACKEND=Agg
USER 1000
WORKDIR /data
ENTRYPOINT ["run_pipeline"]
