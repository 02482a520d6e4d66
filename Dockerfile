# The MCP server with its models inside; `docker build -t vehanchor .`
#
#   HTTP (default)  docker run -p 8000:8000 -v $PWD/flights:/images:ro -v $PWD/token:/run/secrets/token:ro \
#                     -e VEHANCHOR_TOKEN_FILE=/run/secrets/token vehanchor
#   stdio           docker run -i --rm --no-healthcheck -v $PWD/flights:/images:ro vehanchor serve
#   anything else   docker run --rm -v $PWD/flights:/images:ro vehanchor estimate photo.jpg --json
#
# It writes nothing: add --read-only --cap-drop ALL --security-opt no-new-privileges.

# The digest is the multi-architecture index of the tag; renew both together.
FROM python:3.11.15-slim-bookworm@sha256:d29f48a31a8b408ed19272ca1e7b10ebae13b240a27e862d3d4217c528e2e0c3 AS python

FROM python AS build
WORKDIR /src
RUN python -m venv --without-pip /opt/vehanchor
COPY requirements/image.txt ./
RUN python -m pip --python /opt/vehanchor/bin/python install --no-cache-dir --require-hashes --requirement image.txt
COPY pyproject.toml README.md LICENSE ./
COPY schemas schemas
COPY skill skill
COPY server server
# Nothing is fetched from here on; setuptools, which builds the package, is not wanted where it runs.
RUN python -m pip --python /opt/vehanchor/bin/python install --no-cache-dir --no-deps --no-build-isolation . \
    && python -m pip --python /opt/vehanchor/bin/python uninstall --yes setuptools

FROM python
LABEL org.opencontainers.image.title="VehAnchor" \
      org.opencontainers.image.description="Metric scale for aerial images without metadata, as an MCP server" \
      org.opencontainers.image.licenses="Apache-2.0"
# libexpat is the one system library that the wheels (GDAL's) want and the base lacks; nothing is installed after it.
# The base has no byte code of Python's own library: without it, each start would compile 130 modules, for 0.2 s.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libexpat1 \
    && rm -rf /var/lib/apt/lists/* \
    && python -m pip uninstall --yes --root-user-action ignore pip setuptools wheel \
    && python -m compileall -q /usr/local/lib/python3.11
COPY --from=build /opt/vehanchor /opt/vehanchor
WORKDIR /images
ENV PATH=/opt/vehanchor/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    ORT_DISABLE_TELEMETRY=1 \
    VEHANCHOR_HOST=0.0.0.0 \
    VEHANCHOR_PORT=8000 \
    VEHANCHOR_ROOTS=/images
USER 10001:10001
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=5s --start-period=30s CMD ["python", "-c", "import os, urllib.request as u; u.urlopen('http://127.0.0.1:' + os.environ['VEHANCHOR_PORT'] + '/healthz', timeout=4)"]
ENTRYPOINT ["vehanchor"]
CMD ["serve", "--http"]
