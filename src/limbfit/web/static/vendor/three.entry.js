// What three.min.js holds: the parts of three.js that camera.js and viewer.js use. See VENDOR.md.
export {
  WebGLRenderer, Scene, OrthographicCamera, Group, Mesh, BufferGeometry, BufferAttribute, ShaderMaterial, MeshLambertMaterial,
  MeshBasicMaterial, HemisphereLight, DirectionalLight, DataTexture, SphereGeometry, CylinderGeometry, Raycaster, Vector2,
  Vector3, Box3, Color, DoubleSide, RGBAFormat, LinearFilter, ColorManagement,
} from "three";
