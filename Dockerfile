# probe-kit with everything the README's two commands need:
#   docker build -t probe-kit . && docker run --rm -v "$PWD/out:/out" probe-kit demo --out /out/demo
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends g++ git && rm -rf /var/lib/apt/lists/*
WORKDIR /probe-kit
COPY . .
RUN ./with-uv probe-kit --version
RUN .venv/bin/probe-kit doctor --json
ENTRYPOINT ["/probe-kit/.venv/bin/probe-kit"]
CMD ["--help"]
