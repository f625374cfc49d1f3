# Three images. `service` runs what computes, records and stores: every extra but `view` and
# `notebook`. `view` adds these to it and runs every command. `truck` is the small one of a truck's
# computer without any extra: publisher and spool, `driveby truck` and `driveby health`. See
# compose.yaml.
#
# The base image is named by its tag: no registry was within reach when this was written, so its
# digest is not known here. For the same image every time give it:
#     docker compose build --build-arg BASE=python:3.11-slim-bookworm@sha256:...
#
# Behind a mirror of PyPI: `PIP_CONFIG_FILE` and `PIP_CERT`, the variables of pip itself, name files
# that compose.yaml hands to the build as secrets. They are in no layer.
ARG BASE=python:3.11-slim-bookworm

FROM ${BASE} AS tools
RUN apt-get update && apt-get install --yes --no-install-recommends binutils
COPY --chmod=0755 docs/scripts/slim_environment.sh /slim_environment
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /build
RUN python -m venv --without-pip /opt/driveby

FROM tools AS wheel
COPY requirements/build.txt requirements/
RUN --mount=type=secret,id=pip,target=/etc/pip.conf --mount=type=secret,id=authorities \
    if [ -s /run/secrets/authorities ]; then export PIP_CERT=/run/secrets/authorities; fi \
    && pip --python /opt/driveby/bin/python install --require-hashes -r requirements/build.txt
COPY LICENSE README.md pyproject.toml setup.py ./
COPY driveby driveby
COPY pre_core pre_core
COPY schemas schemas
COPY services services
# No index: what builds is what was installed above, by hash.
RUN pip --python /opt/driveby/bin/python wheel --no-deps --no-build-isolation --no-index -w /wheels .

FROM tools AS truck-environment
COPY requirements/truck.txt requirements/
RUN --mount=type=secret,id=pip,target=/etc/pip.conf --mount=type=secret,id=authorities \
    if [ -s /run/secrets/authorities ]; then export PIP_CERT=/run/secrets/authorities; fi \
    && pip --python /opt/driveby/bin/python install --require-hashes -r requirements/truck.txt
RUN /slim_environment /opt/driveby
COPY --from=wheel /wheels /wheels
RUN pip --python /opt/driveby/bin/python install --no-deps --no-index /wheels/*.whl

FROM tools AS service-environment
COPY requirements/service.txt requirements/
RUN --mount=type=secret,id=pip,target=/etc/pip.conf --mount=type=secret,id=authorities \
    if [ -s /run/secrets/authorities ]; then export PIP_CERT=/run/secrets/authorities; fi \
    && pip --python /opt/driveby/bin/python install --no-compile --require-hashes -r requirements/service.txt
RUN /slim_environment /opt/driveby
COPY --from=wheel /wheels /wheels
RUN pip --python /opt/driveby/bin/python install --no-deps --no-index /wheels/*.whl

# Only what is new goes into the image, so that it shares all else with `service`.
FROM service-environment AS view-environment
COPY requirements/runtime.txt requirements/
RUN --mount=type=secret,id=pip,target=/etc/pip.conf --mount=type=secret,id=authorities \
    if [ -s /run/secrets/authorities ]; then export PIP_CERT=/run/secrets/authorities; fi \
    && touch /before \
    && pip --python /opt/driveby/bin/python install --no-compile --require-hashes -r requirements/runtime.txt
RUN /slim_environment /opt/driveby && mkdir /new && cd / \
    && find opt/driveby -newer /before ! -type d -print0 | tar --null -cT - | tar -xC /new

FROM ${BASE} AS common
ENV PATH=/opt/driveby/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
ENV PYTHONUNBUFFERED=1 OPENBLAS_NUM_THREADS=1 NUMBA_CACHE_DIR=/tmp/kernels
WORKDIR /app
COPY entrypoint.sh ./
RUN useradd --uid 10001 --create-home driveby \
    && mkdir recordings certs spool \
    && chown driveby recordings certs spool
ENTRYPOINT ["/app/entrypoint.sh"]

FROM common AS truck
COPY --from=truck-environment /opt/driveby /opt/driveby
USER driveby

FROM common AS service
COPY --from=service-environment /opt/driveby /opt/driveby
# Python writes compiled what is imported here, and nothing when it runs: its files are read-only.
# What numba wrote as root is removed: the service writes there itself.
RUN python -c "import driveby.services.logger.run, driveby.services.cli.metrics" \
    && python -c "import driveby.services.worker.run, driveby.services.simulation.drive" \
    && python -c "import distributed, duckdb, pyarrow.parquet, rosbags, s3fs" \
    && driveby health --help >/dev/null \
    && rm -rf /tmp/kernels
# The root file system is read-only and numba wants to write beside what it reads, so entrypoint.sh
# copies these 8 MB to memory.
RUN NUMBA_CACHE_DIR=/app/kernels /app/entrypoint.sh python -m driveby.services.execution.warm_up --strict \
    && NUMBA_CACHE_DIR=/app/kernels /app/entrypoint.sh python -m driveby.services.simulation.warm_up --strict
USER driveby

FROM service AS view
# Matplotlib would write its list of fonts to the home folder, which is read-only.
ENV MPLCONFIGDIR=/tmp/matplotlib
USER root
COPY --from=view-environment /new /
RUN python -c "import driveby.services.viewer.rerun_file" && rm -rf /tmp/kernels /tmp/matplotlib
USER driveby
