// The Gaussians of `export --to splat`, drawn by Spark; loaded when they are asked for.

import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import type { Stage } from "./stage";

/** Shows a PLY of Gaussians made by skyrelief: its y is down, turned back to z up. Gives what removes them. */
export async function showSplats(stage: Stage, address: string): Promise<() => void> {
  const splats = new SplatMesh({ url: address });
  splats.rotation.x = -Math.PI / 2;
  await splats.initialized;
  const spark = new SparkRenderer({ renderer: stage.renderer, onDirty: stage.touch });
  stage.model.add(spark, splats);
  stage.touch();
  document.body.dataset["splats"] = "shown";
  return () => {
    delete document.body.dataset["splats"];
    stage.model.remove(spark, splats);
    splats.dispose();
    spark.dispose();
  };
}
