# PostgreSQL with PostGIS, from PostgreSQL's official image and packages, for amd64 and arm64. (postgis/postgis is for amd64
# only, and its maintainers call the images for arm64 experimental.)
#   docker build -f docker/database.Dockerfile -t fleet-map-database:15.19 docker
FROM postgres:15.19-bookworm

LABEL org.opencontainers.image.title="Fleet Map Server: PostgreSQL with PostGIS" \
      org.opencontainers.image.licenses="Apache-2.0"

# The newest PostGIS 3: the packages of one that is replaced are removed from the index.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends postgresql-15-postgis-3 postgresql-15-postgis-3-scripts \
    && rm -rf /var/lib/apt/lists/*

# As this user it needs no capability. A new volume gets the owner of the image's folder.
USER 999:999
