# Everything in one container: `refine serve`, with a Redis of its own, the service and a worker on the CPU. From the root
# of the repository:
#   docker build -f docker/all-in-one.Dockerfile -t refine .

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

FROM tools AS installed
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
COPY constraints.txt ./
# Without its dependencies, which PyPI has in the versions of constraints.txt.
RUN /tools/bin/pip --python /opt/refine/bin/python install --no-deps \
    --index-url "${TORCH_INDEX}" -c constraints.txt torch
# The dependencies first, with the project empty: a change of its source installs none of them again.
COPY constraints.txt pyproject.toml ./
RUN touch LICENSE README.md && sed -i '/^\[tool.hatch.build.targets.wheel.force-include]/,/^$/d' pyproject.toml && \
    /tools/bin/pip --python /opt/refine/bin/python install -c constraints.txt '.[otel,service,worker]'
COPY --from=wheel /wheels /wheels
RUN /tools/bin/pip --python /opt/refine/bin/python install --no-deps --force-reinstall /wheels/*.whl && \
    /tools/bin/cyclonedx-py environment --output-file /opt/refine/sbom.cdx.json /opt/refine/bin/python

FROM ${BASE}
ARG REVISION
ARG VERSION=0.1.0
LABEL org.opencontainers.image.title="REFINE" \
      org.opencontainers.image.description="Mesh refinement as a service in one container: Redis, REST, gRPC and a worker" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.revision="${REVISION}"
COPY --from=tools /etc/group /etc/passwd /etc/
COPY --from=installed /opt/refine /opt/refine
COPY --from=tools --chown=10001:10001 /var/cache/refine /var/cache/refine
COPY --from=tools --chown=10001:10001 /var/lib/refine /var/lib/refine
ENV NUMBA_CACHE_DIR=/var/cache/refine/numba \
    PATH=/opt/refine/bin:/usr/local/bin:/usr/bin:/bin \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    REFINE_DATA_FOLDER=/var/lib/refine \
    REFINE_HOST=0.0.0.0 \
    XDG_CACHE_HOME=/var/cache/refine
USER 10001:10001
# What may be written: uploads until they are whole; compiled kernels; jobs, blobs, API keys and logs.
VOLUME ["/tmp", "/var/cache/refine", "/var/lib/refine"]
EXPOSE 8000 50051
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=5s --start-period=30s CMD ["python", "-c", "import os, urllib.request; urllib.request.urlopen('http://127.0.0.1:' + os.environ.get('REFINE_HTTP_PORT', '8000') + '/livez', timeout=4)"]
ENTRYPOINT ["refine"]
CMD ["serve"]
