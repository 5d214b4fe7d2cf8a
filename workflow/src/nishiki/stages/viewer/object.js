// The page of an object.
import { start } from "viewer/main";
import { ObjectScene } from "viewer/object";

start(ObjectScene);
