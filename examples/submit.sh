#!/usr/bin/env bash
# Refines a mesh with one curl call: examples/submit.sh [FOLDER] > refined.glb
# FOLDER holds coarse.obj, silhouette.png and camera.json. REFINE_SERVER and REFINE_API_KEY as for the SDK.
set -euo pipefail
folder=${1:-$(dirname "${BASH_SOURCE[0]}")/samples/chair}
key=()
[ -z "${REFINE_API_KEY:-}" ] || key=(-H "Authorization: Bearer $REFINE_API_KEY")

curl --silent --show-error --fail-with-body "${REFINE_SERVER:-http://127.0.0.1:8000}/v1/refinements" \
    ${key[@]+"${key[@]}"} \
    -H "Prefer: wait=60" -H "Accept: model/gltf-binary" \
    -F "mesh=@$folder/coarse.obj" \
    -F "silhouette=@$folder/silhouette.png" \
    -F "camera=@$folder/camera.json" \
    -F 'options={"preset": "fast"}'
