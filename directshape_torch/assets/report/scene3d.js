// This module shows the cars of a frame in 3D: surfaces, boxes before and after, labels, ground. Axes are those of the
// left camera, rotated to y up. The scene is drawn only when something changes.

import * as THREE from "three";
import { OrbitControls } from "three/orbit-controls";
import { meanMesh } from "report/data";
import { counted } from "report/format";
import { readMesh } from "report/mesh";
import { EDGES } from "report/frame_picture";

// The colours are pale, so that they differ from the lines before, after and of the truth.
const PAINTS = [0x9db4cf, 0xcfb79a, 0xa5bf9f, 0xc3a4bd, 0xcac39a, 0xabb3bb];
const COLOURS = { before: 0xff9f1a, after: 0x3aa0ff, truth: 0x35c258 };

export class Viewer {
  constructor(host, openCar) {
    this.host = host;
    this.renderer = new THREE.WebGLRenderer({ antialias: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.canvas = this.renderer.domElement;
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    host.replaceChildren(this.canvas);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.1, 600);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x667788, 2.2), this.camera);
    const lamp = new THREE.DirectionalLight(0xffffff, 1.6);
    lamp.position.set(3, 6, 4);
    this.camera.add(lamp);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.maxPolarAngle = 0.5 * Math.PI;
    this.controls.addEventListener("change", () => this.draw());
    this.controls.listenToKeyEvents(this.canvas);
    this.cars = new THREE.Group();
    this.generation = 0;
    this.listen(openCar);
  }

  listen(openCar) {
    let start = null;
    this.canvas.addEventListener("pointerdown", (event) => { start = [event.clientX, event.clientY]; });
    this.canvas.addEventListener("pointerup", (event) => {
      // A drag rotates the view; only a click without movement opens a car.
      if (start === null || Math.hypot(event.clientX - start[0], event.clientY - start[1]) > 4) return;
      const place = this.carUnder(event);
      if (place !== null) openCar(place);
    });
    new ResizeObserver(() => this.fit()).observe(this.host);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.paintGround(); this.draw(); });
  }

  // `paints` are indices of colours, `paths` positions [x, y, z] of each car in all frames of its track.
  async show(data, shown, label, paints, paths) {
    const generation = ++this.generation;
    const meshes = await Promise.all(data.cars.map((car) => surfaceOf(car)));
    if (generation !== this.generation) return;  // another frame was chosen in the meantime
    const isFirst = this.data === undefined;
    this.data = data;
    this.canvas.setAttribute("aria-label", `${label}: ${counted(data.cars.length, "car")}`);
    release(this.cars);
    this.cars = new THREE.Group();
    // The camera has y down and z forward; the scene has y up.
    this.cars.rotation.x = Math.PI;
    data.cars.forEach((car, place) => this.addCar(car, place, meshes[place], shown, PAINTS[paints[place] % PAINTS.length]));
    if (shown.after) paths.forEach((path, place) => this.cars.add(pathLine(path, PAINTS[paints[place] % PAINTS.length])));
    if (shown.truth) data.truth.forEach((box) => this.cars.add(boxLines(box, COLOURS.truth)));
    this.cars.add(this.groundGrid(data));
    this.scene.add(this.cars);
    this.paintGround();
    this.fit();
    if (isFirst) this.lookFrom("behind");
    this.host.dataset.ready = label;
    this.draw();
  }

  addCar(car, place, mesh, shown, color) {
    if (mesh !== null && shown.after) {
      const material = new THREE.MeshStandardMaterial({ color, roughness: 0.55, metalness: 0.1, side: THREE.DoubleSide });
      const surface = new THREE.Mesh(geometryOf(mesh), material);
      surface.matrixAutoUpdate = false;
      surface.matrix.set(...car.T_cam_obj);
      surface.userData.place = place;
      this.cars.add(surface);
    }
    if (shown.before && car.box_before) this.cars.add(boxLines(car.box_before, COLOURS.before));
    if (shown.after) this.cars.add(boxLines(car.box_after, COLOURS.after));
  }

  groundGrid(data) {
    const centres = data.cars.map((car) => boxCentre(car.box_after));
    const level = centres.length ? Math.max(...data.cars.map((car) => Math.max(...everyThird(car.box_after, 1)))) : 1.65;
    const [nx, ny, nz, offset] = data.ground ?? [0, -1, 0, level];
    const far = 5 * Math.ceil(Math.max(30, ...centres.map((centre) => centre[2] + 5)) / 5);
    const side = 5 * Math.ceil(Math.max(10, ...centres.map((centre) => Math.abs(centre[0]) + 3)) / 5);
    const at = (x, z) => [x, -(nx * x + nz * z + offset) / ny, z];
    const points = [];
    for (let x = -side; x <= side; x += 5) points.push(...at(x, 0), ...at(x, far));
    for (let z = 0; z <= far; z += 5) points.push(...at(-side, z), ...at(side, z));
    this.reach = { far, side };
    this.ground = lines(points, 0x888888);
    return this.ground;
  }

  paintGround() {
    const style = getComputedStyle(this.host);
    this.scene.background = new THREE.Color(style.getPropertyValue("--scene").trim());
    this.ground?.material.color.set(style.getPropertyValue("--grid").trim());
  }

  lookFrom(name) {
    if (this.data === undefined) return;
    const depths = this.data.cars.map((car) => boxCentre(car.box_after)[2]).sort((a, b) => a - b);
    // If the nearest car is far, the view starts nearer to it.
    const ahead = Math.max(0, (depths[0] ?? 0) - 12);
    // The camera is farther back for a narrow canvas, which shows less at the sides.
    const back = Math.max(1, 1.5 / this.camera.aspect);
    const slope = Math.tan(0.5 * this.camera.fov * Math.PI / 180);
    const { far, side } = this.reach;
    const height = 1.1 * Math.max(0.5 * far, side / this.camera.aspect) / slope;
    const views = {
      behind: [[0, 4.5 * back, 7 * back - ahead], [0, -1.65, -9 - ahead]],
      camera: [[0, 0, 0], [0, -0.05, -1.5]],
      above: [[0, height, -0.5 * far + 0.1], [0, 0, -0.5 * far]],
    };
    this.camera.position.set(...views[name][0]);
    this.controls.target.set(...views[name][1]);
    this.controls.update();
    this.draw();
  }

  lookAtCar(place, name) {
    const [x, y, z] = boxCentre(this.data.cars[place].box_after);
    this.controls.target.set(x, -y, -z);
    this.camera.position.set(x - 3.2, -y + 3, -z + 6);
    this.controls.update();
    this.host.dataset.car = name;
    this.draw();
    this.canvas.focus({ preventScroll: true });
  }

  carUnder(event) {
    const area = this.canvas.getBoundingClientRect();
    const pointer = new THREE.Vector2(2 * (event.clientX - area.left) / area.width - 1, 1 - 2 * (event.clientY - area.top) / area.height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(pointer, this.camera);
    const hit = ray.intersectObjects(this.cars.children.filter((child) => child.isMesh), false)[0];
    return hit === undefined ? null : hit.object.userData.place;
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.host;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.renderer.render(this.scene, this.camera);
    });
  }
}

async function surfaceOf(car) {
  const packed = car.mesh ?? meanMesh();
  return packed === null ? null : readMesh(packed);
}

function geometryOf({ positions, indices }) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setIndex(new THREE.BufferAttribute(indices, 1));
  geometry.computeVertexNormals();
  return geometry;
}

function boxLines(box, colour) {
  const corner = (id) => box.slice(3 * id, 3 * id + 3);
  const front = [0, 1, 2].map((axis) => 0.5 * (box[axis] + box[3 + axis]));
  const middle = [0, 1, 2].map((axis) => 0.25 * [0, 1, 2, 3].reduce((sum, id) => sum + box[3 * id + axis], 0));
  return lines([...EDGES.flatMap(([a, b]) => [...corner(a), ...corner(b)]), ...middle, ...front], colour);
}

// The path connects consecutive positions and has a cross at each.
function pathLine(path, colour) {
  const ways = path.slice(1).flatMap((place, index) => [...path[index], ...place]);
  const crosses = path.flatMap(([x, y, z]) => [x - 0.2, y, z, x + 0.2, y, z, x, y, z - 0.2, x, y, z + 0.2]);
  return lines([...ways, ...crosses], colour);
}

function lines(points, colour) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: colour }));
}

function release(group) {
  group.removeFromParent();
  group.traverse((node) => { node.geometry?.dispose(); node.material?.dispose(); });
}

const everyThird = (values, first) => values.filter((_, index) => index % 3 === first);
const boxCentre = (box) => [0, 1, 2].map((axis) => everyThird(box, axis).reduce((sum, value) => sum + value, 0) / 8);
