# Only the agent, without server, database and geometry packages. Build from the top of the checkout:
#   docker build -f docker/agent.Dockerfile -t fleet-map-agent .
FROM python:3.11-slim-bookworm

LABEL org.opencontainers.image.title="Fleet Map Server: the robot's agent" \
      org.opencontainers.image.licenses="Apache-2.0"

ENV UV_PROJECT_ENVIRONMENT=/opt/fleetmap \
    UV_LINK_MODE=copy \
    UV_NO_CACHE=1 \
    UV_PYTHON_DOWNLOADS=never

RUN pip install --no-cache-dir --disable-pip-version-check uv==0.13.8 \
    && groupadd --system --gid 10001 fleetmap \
    && useradd --system --uid 10001 --gid fleetmap --home-dir /maps --shell /usr/sbin/nologin fleetmap \
    && install -d -o fleetmap -g fleetmap -m 0755 /maps

WORKDIR /srv/fleetmap
COPY pyproject.toml uv.lock README.md LICENSE ./
RUN uv sync --frozen --no-dev --no-install-project
COPY app ./app
COPY migrations ./migrations
RUN uv sync --frozen --no-dev && python -m compileall -q app

ENV PATH=/opt/fleetmap/bin:/usr/local/bin:/usr/bin:/bin \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1

WORKDIR /maps
VOLUME ["/maps"]
USER 10001:10001
STOPSIGNAL SIGTERM

ENTRYPOINT ["fleetmap", "agent", "--into", "/maps"]
CMD ["--help"]
