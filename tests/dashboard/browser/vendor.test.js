// The files of other packages that the page has, compared with those of the packages in the lock file.
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { copyFileSync, readFileSync } from "node:fs";
import path from "node:path";
import { test } from "node:test";
import { REPOSITORY, temporary } from "./kit.js";

const VENDOR = path.join(REPOSITORY, "src/dashboard/page/vendor");

test("the page's copies are the files of the locked package, byte by byte", () => {
  const folder = temporary();
  for (const name of ["package.json", "package-lock.json"]) copyFileSync(path.join(VENDOR, name), path.join(folder, name));
  // Refuses a package of another hash than that in the lock file.
  execFileSync("npm", ["ci", "--ignore-scripts", "--silent", "--no-audit", "--no-fund"], { cwd: folder });
  const copies = { "uPlot.esm.js": "dist/uPlot.esm.js", "uPlot.min.css": "dist/uPlot.min.css", "uPlot.LICENSE": "LICENSE" };
  for (const [copy, original] of Object.entries(copies)) {
    const [ours, theirs] = [path.join(VENDOR, copy), path.join(folder, "node_modules/uplot", original)].map((file) => readFileSync(file));
    assert.ok(ours.equals(theirs), `${copy} differs from ${original} of the package`);
  }
});
