# The worker, on the CPU (target cpu, a CPU build of torch) or on NVIDIA cards (target cuda). From the root of the
# repository:
#   docker build -f docker/worker.Dockerfile --target cpu -t refine-worker:cpu .

# A Debian with Python 3.11 or newer and venv. The digest is that of every architecture; docker/README.md says how to
# move it, and how to build on a base of your own.
ARG BASE=python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b

# -- the same in every image, so that it is built once ----------------------------------------------------------------
FROM ${BASE} AS tools
ARG PIP_INDEX_URL=https://pypi.org/simple
ARG PIP_CERT
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python3 -m venv /tools && /tools/bin/pip install cyclonedx-bom==7.5.0 && python3 -m venv --without-pip /opt/refine
RUN groupadd --gid 10001 refine && \
    useradd --uid 10001 --gid 10001 --home-dir /var/lib/refine --no-create-home --shell /usr/sbin/nologin refine && \
    mkdir -p /var/cache/refine /var/lib/refine/blobs /var/lib/refine/keys
WORKDIR /source

FROM tools AS wheel
COPY . .
RUN /tools/bin/pip wheel --no-deps --wheel-dir /wheels .
# ---------------------------------------------------------------------------------------------------------------------

FROM tools AS installed-cpu
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
COPY constraints.txt ./
# Without its dependencies, which PyPI has in the versions of constraints.txt.
RUN /tools/bin/pip --python /opt/refine/bin/python install --no-deps \
    --index-url "${TORCH_INDEX}" -c constraints.txt torch
# The dependencies first, with the project empty: a change of its source installs none of them again.
COPY constraints.txt pyproject.toml ./
RUN touch LICENSE README.md && sed -i '/^\[tool.hatch.build.targets.wheel.force-include]/,/^$/d' pyproject.toml && \
    /tools/bin/pip --python /opt/refine/bin/python install -c constraints.txt '.[otel,worker]'
COPY --from=wheel /wheels /wheels
RUN /tools/bin/pip --python /opt/refine/bin/python install --no-deps --force-reinstall /wheels/*.whl && \
    /tools/bin/cyclonedx-py environment --output-file /opt/refine/sbom.cdx.json /opt/refine/bin/python

# PyPI's build of torch for Linux is that for CUDA.
FROM tools AS installed-cuda
COPY constraints.txt pyproject.toml ./
RUN touch LICENSE README.md && sed -i '/^\[tool.hatch.build.targets.wheel.force-include]/,/^$/d' pyproject.toml && \
    /tools/bin/pip --python /opt/refine/bin/python install -c constraints.txt '.[otel,worker]'
COPY --from=wheel /wheels /wheels
RUN /tools/bin/pip --python /opt/refine/bin/python install --no-deps --force-reinstall /wheels/*.whl && \
    /tools/bin/cyclonedx-py environment --output-file /opt/refine/sbom.cdx.json /opt/refine/bin/python

FROM ${BASE} AS worker
ARG REVISION
ARG VERSION=0.1.0
LABEL org.opencontainers.image.title="REFINE worker" \
      org.opencontainers.image.description="Takes mesh refinements from the queue and computes them" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.revision="${REVISION}"
COPY --from=tools /etc/group /etc/passwd /etc/
COPY --from=tools --chown=10001:10001 /var/cache/refine /var/cache/refine
COPY --from=tools --chown=10001:10001 /var/lib/refine/blobs /var/lib/refine/blobs
ENV NUMBA_CACHE_DIR=/var/cache/refine/numba \
    PATH=/opt/refine/bin:/usr/local/bin:/usr/bin:/bin \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    REFINE_DATA_FOLDER=/var/lib/refine \
    REFINE_WORKER_HOST=0.0.0.0 \
    REFINE_WORKER_PORT=9000 \
    XDG_CACHE_HOME=/var/cache/refine
STOPSIGNAL SIGTERM
EXPOSE 9000
HEALTHCHECK --interval=10s --timeout=10s --start-period=300s CMD ["refine", "worker", "--check", "ready"]
ENTRYPOINT ["refine"]
CMD ["worker"]

FROM worker AS cpu
COPY --from=installed-cpu /opt/refine /opt/refine
ENV REFINE_DEVICES=cpu
USER 10001:10001
# What may be written: crash reports; compiled kernels; blobs (without a bucket).
VOLUME ["/tmp", "/var/cache/refine", "/var/lib/refine/blobs"]

FROM worker AS cuda
COPY --from=installed-cuda /opt/refine /opt/refine
ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility NVIDIA_VISIBLE_DEVICES=all REFINE_DEVICES=cuda
USER 10001:10001
VOLUME ["/tmp", "/var/cache/refine", "/var/lib/refine/blobs"]
