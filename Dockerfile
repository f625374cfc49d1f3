# One image for every service: the command line says which one runs. See compose.yaml.
#
# The base image is named by its tag: no registry was within reach when this was written, so its
# digest is not known here. Who wants the same image every time gives it:
#     docker compose build --build-arg BASE=python:3.11-slim-bookworm@sha256:...
ARG BASE=python:3.11-slim-bookworm
FROM ${BASE}
ENV PYTHONUNBUFFERED=1 OPENBLAS_NUM_THREADS=1 NUMBA_CACHE_DIR=/tmp/kernels
WORKDIR /app
# `runtime`, or `cluster` for what a Dask cluster needs, too.
ARG REQUIREMENTS=runtime
COPY requirements/runtime.txt requirements/cluster.txt requirements/build.txt requirements/
RUN pip install --no-cache-dir --require-hashes -r requirements/${REQUIREMENTS}.txt -r requirements/build.txt
COPY LICENSE README.md pyproject.toml setup.py entrypoint.sh ./
COPY driveby driveby
COPY pre_core pre_core
COPY schemas schemas
COPY services services
# No index: what builds is what was installed above, by hash. The sources go, so that the kernels are
# compiled for the modules that will run.
RUN pip install --no-cache-dir --no-deps --no-build-isolation --no-index . \
    && rm -rf build driveby driveby.egg-info pre_core schemas services setup.py \
    && useradd --uid 10001 --create-home driveby \
    && mkdir recordings certs \
    && chown driveby recordings certs
# Compiled for the processor that builds; on one of another kind a service compiles once more before
# it connects. The root file system is read-only and numba wants to write beside what it reads, so
# entrypoint.sh copies these 8 MB to memory.
RUN NUMBA_CACHE_DIR=/app/kernels python -m driveby.services.execution.warm_up --strict
USER driveby
ENTRYPOINT ["/app/entrypoint.sh"]
