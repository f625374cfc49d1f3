# One image for every service: the command line says which one runs. See compose.yaml.
FROM python:3.11-slim
ENV PYTHONUNBUFFERED=1
WORKDIR /app
COPY requirements/runtime.txt requirements/
RUN pip install --no-cache-dir --require-hashes -r requirements/runtime.txt
COPY LICENSE README.md pyproject.toml setup.py ./
COPY driveby driveby
COPY pre_core pre_core
COPY schemas schemas
COPY services services
RUN pip install --no-cache-dir --no-deps . \
    && useradd --create-home driveby \
    && mkdir recordings certs \
    && chown driveby recordings certs
USER driveby
ENTRYPOINT ["driveby"]
