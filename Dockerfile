# docker build -t mosca . && docker run --rm -v "$PWD":/work mosca run actor
FROM python:3.12-slim

COPY . /source
RUN pip install --no-cache-dir -c /source/constraints.txt /source \
    && rm -r /source \
    && useradd --uid 1000 --create-home mosca \
    && install -d -o mosca /kernels /work

# compiled once, in a folder of its own: docker run -v mosca-kernels:/kernels keeps it
ENV NUMBA_CACHE_DIR=/kernels
USER 1000
WORKDIR /work
ENTRYPOINT ["mosca"]
CMD ["--help"]
