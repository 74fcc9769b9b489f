# The smoke preset, as a user who is not root:
#   docker build -t qdos .
#   docker run --rm qdos
# Data and runs outlive the container in a volume:
#   docker run --rm -v qdos:/home/qdos qdos train --env antmaze-large --out runs/large
#   docker run --rm -v qdos:/home/qdos --entrypoint cat qdos runs/large/report.html > report.html
FROM python:3.11-slim-bookworm

# EGL and Mesa draw frames without a display; without them a report has no pictures.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*
RUN useradd --create-home qdos

WORKDIR /opt/qdos
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY configs configs
COPY envs envs
COPY qdos_brax qdos_brax
RUN pip install --no-cache-dir -c constraints.txt ".[manipulation,video]"

USER qdos
WORKDIR /home/qdos
ENTRYPOINT ["qdos"]
CMD ["train", "--env", "antsoccer", "--preset", "smoke"]
