// Views of a turntable object: captured ones, between them, free ones; and whose residual each of them shows.
import { cameraAlong, fitted, freeView, lookAt, neighbours, positionAlong, positionOfEye } from "viewer/cameras";

export class ObjectViews {
  constructor(manifest) {
    this.manifest = manifest;
  }

  /** View that a scene opens with. */
  first() {
    return { ...freeView(this.manifest.views[0], this.manifest.centre), captured: 0 };
  }

  /** View of a state; the first one where the state has none of an object. */
  of(state) {
    return state.view?.eye || Number.isFinite(state.view?.captured) ? state.view : this.first();
  }

  /** The same view by eye, target, up and field of view alone. */
  freed(state) {
    const view = this.of(state), captured = view.captured ?? null;
    if (captured === null) return view;
    return freeView(cameraAlong(this.manifest.views, this.manifest.turn, captured), this.manifest.centre);
  }

  /** View of the captured camera `steps` further than the nearest one. */
  stepped(state, steps) {
    const { views, turn } = this.manifest, nearest = this.nearest(this.camera(this.of(state)).position);
    const last = views.length - 1, captured = nearest + steps;
    const index = turn.closed ? (captured + views.length) % views.length : Math.min(Math.max(captured, 0), last);
    return { ...freeView(views[index], this.manifest.centre), captured: index };
  }

  /** Number of the captured view that is nearest to a position along the turn. */
  nearest(position) {
    const { turn } = this.manifest;
    const apart = (at) => {
      const off = Math.abs(at - position);
      return turn.closed ? Math.min(off, turn.length - off) : off;
    };
    return turn.position.reduce((best, at, n) => (apart(at) < apart(turn.position[best]) ? n : best), 0);
  }

  /** The camera of a view for a picture of some size, and its position along the turn. */
  camera(view, size = { width: 1, height: 1 }) {
    const { views, turn } = this.manifest, captured = view.captured ?? null;
    const camera = captured === null
      ? lookAt(view, size.height, size.width)
      : fitted(cameraAlong(views, turn, captured), size.height, size.width);
    const position = captured === null ? positionOfEye(turn, views, view.eye) : positionAlong(turn, captured);
    return { camera, position };
  }

  /** Captured views, with weights, whose residual a view at a position along the turn shows. */
  lending(view, position) {
    const { turn, without } = this.manifest, captured = view.captured ?? null;
    if (captured !== null && Number.isInteger(captured) && !without.includes(captured)) {
      return [{ view: captured, weight: 1 }];
    }
    return neighbours(turn, position, without);
  }
}
