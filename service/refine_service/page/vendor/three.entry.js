// What the page takes of three.js; scripts/vendor-page makes three.js, the one file beside this, from it.
export {
  BufferAttribute, BufferGeometry, Camera, Color, DirectionalLight, DoubleSide, EdgesGeometry, HemisphereLight,
  LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera, Scene, SRGBColorSpace, Vector3, WebGLRenderer, WebGLRenderTarget,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
export { OBJLoader } from "three/addons/loaders/OBJLoader.js";
export { PLYLoader } from "three/addons/loaders/PLYLoader.js";
export { STLLoader } from "three/addons/loaders/STLLoader.js";
