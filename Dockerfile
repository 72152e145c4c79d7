# The service and the mock bench run from the same image; docker-compose.yml says which command each starts.
FROM python:3.11-slim
RUN useradd --create-home calibench && mkdir /data && chown calibench /data
WORKDIR /srv/calibench
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY calibench calibench
COPY sim sim
COPY drivers drivers
COPY lab lab
COPY api api
COPY mocks mocks
COPY scripts/compile_loops.py scripts/
RUN pip install --no-cache-dir -c constraints.txt '.[postgresql]' && python scripts/compile_loops.py
USER calibench
ENV CALIBENCH_DATA=/data PYTHONUNBUFFERED=1
VOLUME /data
CMD ["calibench", "serve"]
