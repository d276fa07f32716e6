# The service: REST and gRPC, without torch. From the root of the repository:
#   docker build -f docker/service.Dockerfile -t refine-service .

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
# The dependencies first, with the project empty: a change of its source installs none of them again.
COPY constraints.txt pyproject.toml ./
RUN touch LICENSE README.md && sed -i '/^\[tool.hatch.build.targets.wheel.force-include]/,/^$/d' pyproject.toml && \
    /tools/bin/pip --python /opt/refine/bin/python install -c constraints.txt '.[otel,service]'
COPY --from=wheel /wheels /wheels
RUN /tools/bin/pip --python /opt/refine/bin/python install --no-deps --force-reinstall /wheels/*.whl && \
    /tools/bin/cyclonedx-py environment --output-file /opt/refine/sbom.cdx.json /opt/refine/bin/python

FROM ${BASE}
ARG REVISION
ARG VERSION=0.1.0
LABEL org.opencontainers.image.title="REFINE service" \
      org.opencontainers.image.description="REST and gRPC in front of the queue of mesh refinements" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.revision="${REVISION}"
COPY --from=tools /etc/group /etc/passwd /etc/
COPY --from=installed /opt/refine /opt/refine
COPY --from=tools --chown=10001:10001 /var/lib/refine /var/lib/refine
ENV PATH=/opt/refine/bin:/usr/local/bin:/usr/bin:/bin \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    REFINE_DATA_FOLDER=/var/lib/refine \
    REFINE_HOST=0.0.0.0 \
    REFINE_KEYS_FILE=/var/lib/refine/keys/keys.json
USER 10001:10001
# What may be written: uploads until they are whole; blobs (without a bucket); API keys.
VOLUME ["/tmp", "/var/lib/refine/blobs", "/var/lib/refine/keys"]
EXPOSE 8000 50051
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=5s --start-period=30s CMD ["python", "-c", "import os, urllib.request; urllib.request.urlopen('http://127.0.0.1:' + os.environ.get('REFINE_HTTP_PORT', '8000') + '/livez', timeout=4)"]
ENTRYPOINT ["refine"]
CMD ["service"]
