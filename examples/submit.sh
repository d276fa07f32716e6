#!/usr/bin/env bash
# Refines a mesh with curl: examples/submit.sh [FOLDER] > refined.glb
# FOLDER holds coarse.obj, silhouette.png and camera.json. REFINE_SERVER and REFINE_API_KEY as for the SDK.
# One call waits 60 s; while the answer is 406, not ready yet, the same call with the same key waits on.
set -euo pipefail
folder=${1:-$(dirname "${BASH_SOURCE[0]}")/samples/chair}
key=()
[ -z "${REFINE_API_KEY:-}" ] || key=(-H "Authorization: Bearer $REFINE_API_KEY")
answer=$(mktemp)
trap 'rm -f "$answer"' EXIT
once=$(od -An -N16 -tx1 /dev/urandom | tr -d ' \n')

status=406
while [ "$status" = 406 ]; do
    status=$(curl --silent --show-error --output "$answer" --write-out '%{http_code}' \
        "${REFINE_SERVER:-http://127.0.0.1:8000}/v1/refinements" \
        ${key[@]+"${key[@]}"} \
        -H "Accept: model/gltf-binary" -H "Idempotency-Key: $once" \
        -F "mesh=@$folder/coarse.obj" \
        -F "silhouette=@$folder/silhouette.png" \
        -F "camera=@$folder/camera.json" \
        -F 'options={"preset": "fast"}')
done
[ "$status" = 200 ] || { cat "$answer" >&2; exit 1; }
cat "$answer"
