// This module unpacks meshes of `mesh_data` in page_parts.py: differences of whole numbers, zlib, base64.

const PER_METRE = 1000;

export async function readMesh(packed) {
  const [coordinates, faces] = await Promise.all([unpack(packed.vertices), unpack(packed.faces)]);
  const count = coordinates.length / 3;
  const positions = new Float32Array(coordinates.length);
  for (let vertex = 0; vertex < count; vertex++) {
    for (let axis = 0; axis < 3; axis++) positions[3 * vertex + axis] = coordinates[axis * count + vertex] / PER_METRE;
  }
  return { positions, indices: Uint32Array.from(faces) };
}

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const view = new DataView(await new Response(inflated).arrayBuffer());
  const numbers = new Int32Array(view.byteLength / 4);
  let sum = 0;
  for (let index = 0; index < numbers.length; index++) {
    sum += view.getInt32(4 * index, true);
    numbers[index] = sum;
  }
  return numbers;
}
