// What three.min.js holds: the parts of three.js that viewer.js uses. See VENDOR.md.
export {
  WebGLRenderer, Scene, OrthographicCamera, Group, Mesh, LineSegments, BufferGeometry, BufferAttribute, ShaderMaterial,
  MeshLambertMaterial, MeshBasicMaterial, LineBasicMaterial, HemisphereLight, DirectionalLight, DataTexture, SphereGeometry,
  CylinderGeometry, ConeGeometry, Raycaster, Vector2, Vector3, Matrix4, Box3, Sphere, Plane, Quaternion, Color, DoubleSide,
  FrontSide, RGBAFormat, LinearFilter, ColorManagement,
} from "three";
export { TrackballControls } from "three/examples/jsm/controls/TrackballControls.js";
