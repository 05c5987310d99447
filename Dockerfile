# dvo with its weights, on Python and the CPU build of torch.
#   docker build -t dvo .
#   docker run --rm -v "$PWD:/work" dvo                  # dvo demo; results in ./runs
#   docker run --rm -v "$PWD:/work" dvo run video.mp4
# For a GPU: docker build --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu126, and docker run --gpus all.
FROM python:3.11-slim

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
# The version range is that of pyproject.toml.
RUN pip install --no-cache-dir --index-url "$TORCH_INDEX" "torch>=2.4,<2.14"

COPY pyproject.toml README.md LICENSE /src/
COPY dvo /src/dvo
RUN pip install --no-cache-dir /src

# Results belong to the first user of most machines; --user chooses another one.
RUN useradd --uid 1000 --create-home dvo && install -d -o dvo /work
USER dvo
WORKDIR /work
ENTRYPOINT ["dvo"]
CMD ["demo"]
