#!/usr/bin/env bash
# Makes the libraries of a report's page anew from their packages in npm's registry. Versions are said here; those of
# what NiiVue itself uses are the newest that it allows. Needs npm. After a change: compare LICENCES.txt with the packages' own, and put the sums into README.md.
set -euo pipefail
niivue=0.69.0 uplot=1.6.32 esbuild=0.28.2

here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm init -y >/dev/null
npm install --no-audit --no-fund --silent "@niivue/niivue@$niivue" "uplot@$uplot" "esbuild@$esbuild"

# NiiVue reads Zarr too, with decompressors that are more than half of it. A page's volumes are none: an empty module stands
# for that reader.
cat > entry.js <<'JS'
export { Niivue, NVImage } from "@niivue/niivue";
JS
cat > no-zarr.js <<'JS'
const none = () => { throw new Error("this build reads no Zarr"); };
export class FetchStore {}
export { none as get, none as open, none as root, none as slice, none as tryWithConsolidated, none as withConsolidated };
JS
npx esbuild entry.js --bundle --minify --format=iife --global-name=niivue --alias:zarrita=./no-zarr.js --legal-comments=none \
    --log-level=warning --outfile="$here/niivue.min.js"
cp node_modules/uplot/dist/uPlot.iife.min.js node_modules/uplot/dist/uPlot.min.css "$here/"
cd "$here"
wc -c niivue.min.js uPlot.iife.min.js uPlot.min.css
sha256sum niivue.min.js uPlot.iife.min.js uPlot.min.css
